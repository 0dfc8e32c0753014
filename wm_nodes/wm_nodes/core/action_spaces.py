"""What actions and states of the robot's tool mean. A simulated task chooses one: SimulatorPart.actions."""

from dataclasses import dataclass

from wm_nodes.core.specs import EnvironmentSpec

AXES = ("x", "y", "z")
MAX_TILT_RAD, MAX_YAW_RAD = 0.6, 1.8
"""Largest commanded turn of a pose about x and y, and about z: all that the tasks need, and less than half a turn in
all, so that the rotation vector never jumps."""


@dataclass(frozen=True)
class ActionSpace:
    """What an action (A,) in [-1, 1] moves, and the state (S,) that it commands."""

    action_names: tuple[str, ...]
    """Of an action's values."""
    state_names: tuple[str, ...]
    """Of a state's values, each commanded by the action's of the same place."""
    units: tuple[str, ...]
    """Of both: m, rad, or 1."""


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


def tool_columns(spec: EnvironmentSpec) -> tuple[list[int], list[int]]:
    """Which values of an action and of a state are the tool's position (x, y, z).

    Raises:
        ValueError: the robot commands no such position.
    """
    wanted = ((spec.action_names, TRANSLATION.action_names), (spec.state_names, TRANSLATION.state_names))
    for names, position in wanted:
        if missing := [name for name in position if name not in names]:
            raise ValueError(f"environment {spec.env_id} has no {', '.join(missing)}, only {', '.join(names)}; a robot "
                             "whose tool is not commanded by its position cannot be judged by where it is")
    actions, states = ([names.index(name) for name in position] for names, position in wanted)
    return actions, states
