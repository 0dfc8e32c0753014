"""What a plain ROS bag means, in one YAML file: which topics are pictures, state and commands, where episodes begin and
end, what a success is. It holds no code, and an unknown key is an error. example.yaml beside this file shows all."""

import re
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from wm_nodes.config.load import read_yaml, refusal
from wm_nodes.config.sections import NonNegativeInt, PositiveFloat, PositiveInt, SettingsSection
from wm_nodes.config.tasks import get_task, task_names
from wm_nodes.core.specs import TARGET, TASK_PREFIX

BOOL, STRING = "std_msgs/msg/Bool", "std_msgs/msg/String"
IMAGE = "sensor_msgs/msg/Image"
Clock = Literal["header", "receive"]


class Source(SettingsSection):
    """One topic."""

    topic: Annotated[str, Field(pattern="^/.")]
    """Absolute name."""
    type: str
    """Of its messages, e.g. sensor_msgs/msg/JointState."""
    timeline: Clock | None = None
    """Its clock, where that is another than the contract's."""
    max_age_ms: PositiveFloat | None = None
    """How old its newest sample may be, where that is another than the contract's."""


class Camera(Source):
    """A topic of pictures."""

    type: Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"]
    """Image with encoding rgb8, bgr8, rgba8, bgra8 or mono8, or CompressedImage (JPEG, PNG)."""
    size: tuple[PositiveInt, PositiveInt]
    """Height and width that pictures are scaled down to, px; one for all cameras."""
    crop: Literal["centre", "none"] | tuple[NonNegativeInt, NonNegativeInt, PositiveInt, PositiveInt] = "centre"
    """What is kept before scaling: centre, the largest part in the middle of the shape of `size`; none, all of it; or
    top, left, height and width in px."""


class Numbers(Source):
    """Numbers out of the messages of one topic."""

    select: Annotated[tuple[str, ...], Field(min_length=1)]
    """Fields by their dotted names: twist.linear.x; of JointState and JointTrajectory position.JOINT, velocity.JOINT,
    effort.JOINT; of arrays "0", "1"."""
    names: tuple[str, ...] = ()
    """What they are called in our bags; empty: as they are selected."""
    unit: str
    """Of all of them: m, rad, m/s, 1."""

    @property
    def value_names(self) -> tuple[str, ...]:
        return self.names or self.select

    @model_validator(mode="after")
    def _named(self) -> Self:
        if self.names:
            self._check_one_for_each(names=self.names)
        return self

    def _check_one_for_each(self, **listed: tuple[object, ...]) -> None:
        lengths = {name: len(values) for name, values in listed.items()}
        if wrong := {name: length for name, length in lengths.items() if length != len(self.select)}:
            raise ValueError(f"{self.topic} selects {len(self.select)} values, but has {wrong}; give one for each")


class Commands(Numbers):
    """Commands to the robot, part of the action. Action t is commanded in [t, t + 1)."""

    low: Annotated[tuple[float, ...], Field(min_length=1)]
    """The command, in its unit, that becomes the action -1; one for each selected value."""
    high: Annotated[tuple[float, ...], Field(min_length=1)]
    """The command that becomes the action 1."""
    resample: Literal["mean", "last"]
    """What the action of a step is: the mean over its time (velocities), or the last command (positions). A command
    holds until the next; one that is older than max_age_ms at the tick no longer counts."""
    relative_to: Literal["nothing", "state"] = "nothing"
    """state: the command less the state value of the same name at t, as for targets of joints; of unit rad the shorter
    way round, in [-pi, pi)."""

    @model_validator(mode="after")
    def _box(self) -> Self:
        self._check_one_for_each(low=self.low, high=self.high)
        if any(low >= high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"{self.topic}: low {self.low} must be below high {self.high}")
        return self


class Observations(SettingsSection):
    """What the policy sees."""

    images: Annotated[dict[str, Camera], Field(min_length=1)]
    """Cameras by name, side by side in this order."""
    state: tuple[Numbers, ...] = ()
    """Measured values, one after the other; empty: pictures alone."""


class Split(SettingsSection):
    """Where episodes begin and end: one of these."""

    topic: str = ""
    """Of std_msgs/msg/Bool: True begins an episode, False ends it."""
    per: Literal["bag"] | None = None
    """bag: each bag is one episode."""
    gap_s: PositiveFloat | None = None
    """A longer silence of all commands lies between two episodes."""

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(map(bool, (self.topic, self.per, self.gap_s))) != 1:
            raise ValueError("give one of topic: /NAME, per: bag, gap_s: SECONDS")
        return self


class Success(SettingsSection):
    """Which episodes succeeded: a topic, or a file of labels."""

    topic: str = ""
    """Its newest message at or before t says it of frame t. The last frame is a success also where the newest before
    the next episode says so, or, where three or more came within the episode, the newest until half a step after its
    end."""
    type: Literal["std_msgs/msg/Bool", "std_msgs/msg/Float32", "std_msgs/msg/Float64"] = "std_msgs/msg/Bool"
    """Bool says success; a number is the reward, which is recorded too."""
    above: float | None = None
    """A reward above it is a success."""
    file: str = ""
    """CSV with the columns bag (its folder's name), start_s, end_s, success (0 or 1), s since the bag's first message;
    empty start_s and end_s: the whole bag. A path in the contract's folder. It labels the last frame."""

    @model_validator(mode="after")
    def _one(self) -> Self:
        if bool(self.topic) == bool(self.file):
            raise ValueError("give one of topic: /NAME and file: LABELS.csv")
        if (self.type != BOOL) != (self.above is not None):
            raise ValueError(f"`above` is the limit of a reward: give it with std_msgs/msg/Float64, not {self.type}")
        return self


class InstructionTopic(SettingsSection):
    """Instructions that were recorded."""

    topic: str
    """Of std_msgs/msg/String; the newest before an episode's end counts."""


class EpisodeRules(SettingsSection):
    """What an episode is."""

    split: Split
    """Where episodes begin and end."""
    success: Success
    """Which of them succeeded."""
    instruction: str | InstructionTopic
    """What the robot was asked to do: a text, or a topic."""
    behaviour: str = "expert"
    """Who acted, as our bags call it."""
    min_steps: PositiveInt = 4
    """What is shorter is left out, and counted."""


class Contract(SettingsSection):
    """The whole file."""

    format: Literal[1]
    """Version of this form."""
    robot: str
    """What our bags call the environment."""
    task: Annotated[str, Field(pattern=r"^[A-Za-z]\w*$")]
    """Name of what success is about: letters, digits, _."""
    rate_hz: PositiveFloat
    """Steps per second of policy and model. All topics are brought to this clock."""
    timeline: Clock
    """header: messages count from the stamp in their header, and those without one from when the recorder received
    them; receive: all from when they were received."""
    max_age_ms: PositiveFloat = 300
    """A tick at which the newest sample of a topic is older has none: it ends the stretch, and nothing is filled."""
    max_clock_offset_ms: PositiveFloat | None = None
    """By how much the stamps of two topics may lie apart when their messages are received at the same time. None: 500;
    and where some topics count from their reception, the least offset of the others may be half a step."""
    observations: Observations
    """What the policy sees."""
    actions: Annotated[tuple[Commands, ...], Field(min_length=1)]
    """What it commands, one after the other."""
    probes: tuple[Numbers, ...] = ()
    """Recorded values that the world model learns to read off its pictures, as the pose of a goal: so that small things
    are not lost. Only training needs them; the policy never sees them."""
    beyond_limits: Literal["refuse", "clip"] = "refuse"
    """What is done with commands beyond low and high; clip: they become -1 or 1, and are counted."""
    episodes: EpisodeRules
    """What an episode is."""

    @property
    def state_names(self) -> list[str]:
        return [name for source in self.observations.state for name in source.value_names]

    @property
    def action_names(self) -> list[str]:
        return [name for source in self.actions for name in source.value_names]

    @property
    def probed_names(self) -> list[str]:
        return [name for source in self.probes for name in source.value_names]

    @property
    def period_ns(self) -> int:
        return round(1e9 / self.rate_hz)

    def sources(self) -> dict[str, Source]:
        """Every topic that is read, by its place in the contract."""
        rules = self.episodes
        read: dict[str, Source] = {f"images.{name}": camera for name, camera in self.observations.images.items()}
        read |= {f"state.{number}": source for number, source in enumerate(self.observations.state)}
        read |= {f"actions.{number}": source for number, source in enumerate(self.actions)}
        read |= {f"probes.{number}": source for number, source in enumerate(self.probes)}
        if rules.split.topic:
            read["split"] = Source(topic=rules.split.topic, type=BOOL)
        if rules.success.topic:
            read["success"] = Source(topic=rules.success.topic, type=rules.success.type)
        if isinstance(rules.instruction, InstructionTopic):
            read["instruction"] = Source(topic=rules.instruction.topic, type=STRING)
        return read

    def max_age_ns(self, source: Source) -> int:
        return round(1e6 * (source.max_age_ms or self.max_age_ms))

    @model_validator(mode="after")
    def _fits(self) -> Self:
        sizes = {name: camera.size for name, camera in self.observations.images.items()}
        if len(set(sizes.values())) > 1:
            raise ValueError(f"cameras have the sizes {sizes}; give all of them one size")
        for kind, names in (
            ("state", self.state_names), ("action", self.action_names), ("probe", self.probed_names)
        ):
            if twice := {name for name in names if names.count(name) > 1}:
                raise ValueError(f"several {kind} values are called {', '.join(sorted(twice))}; give them `names`")
        if self.probes and self.task in task_names() and self.probed_names != [*get_task(self.task).ground_truth_names]:
            raise ValueError(f"task {self.task!r} is a known one, whose success is told from values of its own, not "
                             "from these probes; give it another name")
        if wrong := [name for name in self.state_names if TARGET in name or name.startswith(TASK_PREFIX)]:
            raise ValueError(f"measured values are called {', '.join(wrong)}, but {TARGET!r} means commanded and "
                             f"{TASK_PREFIX!r} a task in our bags; give them other `names`")
        if wrong := [name for name in self.observations.images if not re.fullmatch(r"[A-Za-z]\w*", name)]:
            raise ValueError(f"camera {wrong[0]!r}: a name has letters, digits and _")
        for source in self.actions:
            missing = [name for name in source.value_names if name not in self.state_names]
            if source.relative_to == "state" and missing:
                raise ValueError(f"{source.topic} is relative to the state, which has no {', '.join(missing)}; select "
                                 "them in observations.state, or give `names` that are there")
        return self


def load_contract(path: Path) -> Contract:
    """Read a contract. Raises ConfigError: names each refused value, or line and remedy where it is no YAML."""
    values = read_yaml(path)
    try:
        contract = Contract.model_validate(values)
    except ValidationError as error:
        raise refusal(error, "wm_nodes/recording/imported/contract.py", str(path)) from None
    rules = contract.episodes
    if not rules.success.file:
        return contract
    success = rules.success.with_values(file=str(path.parent / rules.success.file))
    return contract.with_values(episodes=rules.with_values(success=success))
