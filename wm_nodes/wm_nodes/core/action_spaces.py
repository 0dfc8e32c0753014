"""What actions and states of the robot's tool mean. A task chooses one: Task.actions."""

from dataclasses import dataclass

from wm_nodes.config.schema import SimulationConfig

AXES = ("x", "y", "z")
MAX_TILT_RAD, MAX_YAW_RAD = 0.6, 1.8
"""Largest commanded turn of a pose about x and y, and about z: all that the tasks need, and less than half a turn in
all, so that the rotation vector never jumps."""


@dataclass(frozen=True)
class ActionSpace:
    """Names and units of an action (A,) in [-1, 1], and of the state (S,) that it commands."""

    action_names: tuple[str, ...]
    state_names: tuple[str, ...]
    units: tuple[str, ...]

    def scale(self, config: SimulationConfig) -> tuple[float, ...]:
        """Of a full-scale action, in the units."""
        by_unit = {"m": config.max_action_m, "rad": config.max_action_rad, "1": 1.0}
        return tuple(by_unit[unit] for unit in self.units)

    def box(self, config: SimulationConfig) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Least and largest state."""
        rest = (MAX_TILT_RAD, MAX_TILT_RAD, MAX_YAW_RAD, 1.0)[: len(self.units) - 3]
        return (*config.workspace_low_m, *(-limit for limit in rest)), (*config.workspace_high_m, *rest)


TRANSLATION = ActionSpace(
    tuple(f"tool_d{axis}" for axis in AXES), tuple(f"tool_target_{axis}" for axis in AXES), ("m", "m", "m")
)
"""The tool moves, its rotation and the closed gripper stay."""
POSE = ActionSpace(
    (*TRANSLATION.action_names, *(f"tool_dr{axis}" for axis in AXES), "gripper"),
    (*TRANSLATION.state_names, *(f"tool_target_r{axis}" for axis in AXES), "gripper_target"),
    (*TRANSLATION.units, "rad", "rad", "rad", "1"),
)
"""The tool moves and turns about the axes of the robot's base, by a rotation vector; the gripper's command is absolute,
-1 closed, 1 open. State: position, rotation vector from the tool that points straight down, gripper command."""
SPACES = {"translation": TRANSLATION, "pose": POSE}
