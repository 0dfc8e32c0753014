"""What an environment is: what fixes shapes, units and order on the wire and in a bag."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from wm_nodes.config.schema import SimulationConfig
from wm_nodes.config.tasks import get_task, instruction
from wm_nodes.core.action_spaces import SPACES

SOURCE_IMAGINED, SOURCE_SIMULATOR, SOURCE_REAL, SOURCE_REPLAY = 0, 1, 2, 3

TASK_PREFIX = "task_"
"""Of the names of those state values that say which task an episode is of."""
POLICY_FIELDS = (
    "height", "width", "channels", "encoding", "cameras", "action_names", "action_units", "action_scale", "state_names",
    "state_units", "control_period_s",
)
"""What a policy depends on."""


@dataclass(frozen=True)
class EnvironmentSpec:
    """See msgs_schema/msg/EnvSpec.msg, field by field. Sizes in px, control_period_s in s."""

    env_id: str
    task: str
    instruction: str
    source: int
    num_envs: int
    height: int
    width: int
    cameras: tuple[str, ...]
    action_names: tuple[str, ...]
    action_units: tuple[str, ...]
    action_scale: tuple[float, ...]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    ground_truth_names: tuple[str, ...]
    control_period_s: float
    max_episode_steps: int
    state_low: tuple[float, ...] = ()
    state_high: tuple[float, ...] = ()
    """Box that actions cannot leave, state units; empty: no box."""
    world_model_sha256: str = ""
    channels: int = 3
    encoding: str = "rgb8"

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


def _round_to_sent(value: Any) -> Any:
    if isinstance(value, float):
        return as_sent(value)
    return tuple(_round_to_sent(item) for item in value) if isinstance(value, (tuple, list)) else value


def simulation_spec(task: str, config: SimulationConfig, num_envs: int) -> EnvironmentSpec:
    """The spec of `task` in ManiSkill; the imagined environment shares all but env_id, source and ground truth."""
    what = get_task(task)
    space = SPACES[what.actions]
    low, high = space.box(config)
    codes = tuple(TASK_PREFIX + part for part in what.parts)
    return EnvironmentSpec(
        env_id=f"maniskill/{task}", task=task, instruction=instruction(task, config.scenes), source=SOURCE_SIMULATOR,
        num_envs=num_envs, height=config.image_size, width=config.image_size * len(config.cameras),
        cameras=tuple(config.cameras), action_names=space.action_names, action_units=space.units,
        action_scale=space.scale(config), state_names=space.state_names + codes,
        state_units=space.units + ("1",) * len(codes),
        ground_truth_names=what.ground_truth_names, control_period_s=1.0 / config.control_hz,
        max_episode_steps=config.max_episode_steps, state_low=low + (0.0,) * len(codes),
        state_high=high + (1.0,) * len(codes),
    )
