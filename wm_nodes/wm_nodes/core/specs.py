"""What an environment is: what fixes shapes, units and order on the wire and in a bag."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

SOURCE_IMAGINED, SOURCE_SIMULATOR, SOURCE_REAL, SOURCE_REPLAY = 0, 1, 2, 3

TASK_PREFIX = "task_"
"""Of the names of those state values that say which task an episode is of."""
TARGET = "target"
"""In the name of a state value that is commanded: computed from the value before, the action and the box. What is named
otherwise is measured: nobody knows it before it is there, and a model has to predict how it changes."""
AXES = ("_x", "_y", "_z")
"""Ends of the names of lengths along an axis."""
POLICY_FIELDS = (
    "height", "width", "channels", "encoding", "cameras", "action_names", "action_units", "action_scale", "state_names",
    "state_units", "control_period_s",
)
"""What a policy depends on."""
MODEL_FIELDS = (*POLICY_FIELDS, "state_low", "state_high")
"""What imagining depends on."""
PICTURES = ("height", "width", "channels", "encoding", "cameras")
ROBOT = ("action_names", "action_units", "state_names", "state_units")


@dataclass(frozen=True)
class EnvironmentSpec:
    """What an environment is; see msgs_schema/msg/EnvSpec.msg, field by field."""

    env_id: str
    """E.g. wm/reach or gymnasium/Pendulum-v1."""
    task: str
    """E.g. reach."""
    instruction: str
    """The task in natural language."""
    source: int
    """EnvSpec.SOURCE_* as an int."""
    num_envs: int
    """N, environments that step together."""
    height: int
    """Of one environment's image, px."""
    width: int
    """Of one environment's image, px, all cameras side by side."""
    cameras: tuple[str, ...]
    """Left to right inside an image."""
    action_names: tuple[str, ...]
    """(A,), e.g. tool_dx."""
    action_units: tuple[str, ...]
    """(A,), unit of one full-scale action (value 1.0)."""
    action_scale: tuple[float, ...]
    """(A,), physical size of action 1.0, in action_units."""
    state_names: tuple[str, ...]
    """(S,), e.g. tool_target_x."""
    state_units: tuple[str, ...]
    """(S,), e.g. m."""
    ground_truth_names: tuple[str, ...]
    """(P,), what the simulator says of the true state; empty where unknown."""
    control_period_s: float
    """Between two observations, s."""
    max_episode_steps: int
    """A step that reaches it is truncated."""
    state_low: tuple[float, ...] = ()
    """(S,), lower side of the box that actions cannot leave, in state_units; empty: no box."""
    state_high: tuple[float, ...] = ()
    """(S,), upper side of that box."""
    world_model_sha256: str = ""
    """Of the world model that imagines; empty for a simulator."""
    channels: int = 3
    """Values per pixel."""
    encoding: str = "rgb8"
    """Of the image, as in sensor_msgs."""

    @property
    def action_dim(self) -> int:
        return len(self.action_names)

    @property
    def state_dim(self) -> int:
        return len(self.state_names)

    @property
    def tool_dim(self) -> int:
        """How many values of a state are the tool's; those that say which task it is come after them."""
        return sum(not name.startswith(TASK_PREFIX) for name in self.state_names)

    @cached_property
    def measured(self) -> tuple[int, ...]:
        """Which values of a state are measured, see TARGET; the others are commanded, or say which task it is."""
        return tuple(i for i, name in enumerate(self.state_names[: self.tool_dim]) if TARGET not in name)

    @cached_property
    def differences(self) -> tuple[tuple[int, int], ...]:
        """Pairs of the tool's state values that are lengths along one axis: the one less the other says how far apart
        two things are."""
        axes = [(i, name[-2:]) for i, name in enumerate(self.state_names[: self.tool_dim]) if name[-2:] in AXES
                and self.state_units[i] == "m"]
        return tuple((i, j) for i, axis in axes for j, other in axes if i < j and axis == other)

    @property
    def commanded_dim(self) -> int:
        """How many values of a state are commanded; in the simulator they come first."""
        return self.tool_dim - len(self.measured)

    @property
    def ground_truth_dim(self) -> int:
        return len(self.ground_truth_names)

    @cached_property
    def spec_hash(self) -> str:
        """sha256 over every field: two sides with equal hashes agree on shapes, units and order."""
        text = json.dumps({name: _round_to_sent(value) for name, value in asdict(self).items()}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def as_sent(value: float) -> float:
    """Return the shortest decimal of the same float32: the number after a trip through a message or a bag."""
    return float(str(np.float32(value)))


def differences(
    found: EnvironmentSpec, expected: EnvironmentSpec, names: Sequence[str] = POLICY_FIELDS
) -> list[tuple[str, Any, Any]]:
    """Return (field, found, expected) for the named fields that disagree, as values that were sent."""
    rows = [(name, *(_round_to_sent(getattr(spec, name)) for spec in (found, expected))) for name in names]
    return [row for row in rows if row[1] != row[2]]


class SpecMismatch(ValueError):
    """Two sides disagree on the environment."""


def agree(
    served: EnvironmentSpec, trained_with: EnvironmentSpec, whose: str, names: Sequence[str] = POLICY_FIELDS, *,
    simulated: str = "start both with the same config_file",
) -> None:
    """Compare the environment that is served with the one that something was trained or recorded with.

    Args:
        whose: of the second, as the message says it, e.g. "the policy needs".
        simulated: the remedy where the environment is a simulator, which can be set up anew.

    Raises:
        SpecMismatch: names each field that differs, and the remedies that fit.
    """
    wrong = differences(served, trained_with, names)
    if not wrong:
        return
    fields_, remedies = {name for name, *_ in wrong}, list[str]()
    if fields_ & {*ROBOT}:
        remedies.append("it is another robot: name the model and policy of this one, or record episodes of it and "
                        "train a model on them")
    elif fields_ & {*PICTURES}:
        remedies.append("show the pictures that it was trained with, or record these and train a model on them")
    if fields_ - {*ROBOT, *PICTURES}:
        remedies.append("set actions, box and control period as they were")
    text = "; ".join(f"{name} {is_!r}, {whose} {should!r}" for name, is_, should in wrong)
    raise SpecMismatch(
        f"environment {served.env_id} has {text}; {', and '.join(remedies)}; in a simulator, {simulated}"
    )


def _round_to_sent(value: Any) -> Any:
    if isinstance(value, float):
        return as_sent(value)
    return tuple(_round_to_sent(item) for item in value) if isinstance(value, (tuple, list)) else value


def spec_values(spec: EnvironmentSpec) -> dict[str, Any]:
    """The fields of a spec as plain values, for JSON."""
    return asdict(spec)


def spec_of_values(values: Mapping[str, Any]) -> EnvironmentSpec:
    """Return the spec of spec_values, with tuples for lists. Raises ValueError for other fields than a spec's."""
    names = {field.name for field in fields(EnvironmentSpec)}
    if set(values) != names:
        raise ValueError(f"a spec has the fields {sorted(names)}; these are too many or missing: "
                         f"{sorted(set(values) ^ names)}")
    arguments: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
    return EnvironmentSpec(**arguments)


def tool_spec(spec: EnvironmentSpec) -> EnvironmentSpec:
    """The spec of one environment without the state values that say which task it is: what a world model is made of."""
    return of_columns(replace(spec, num_envs=1), range(spec.tool_dim))


def of_columns(spec: EnvironmentSpec, columns: Sequence[int]) -> EnvironmentSpec:
    """The spec with these values of the state alone."""
    names = ("state_names", "state_units", *(("state_low", "state_high") if spec.state_low else ()))
    chosen: dict[str, Any] = {name: tuple(getattr(spec, name)[i] for i in columns) for name in names}
    return replace(spec, **chosen)
