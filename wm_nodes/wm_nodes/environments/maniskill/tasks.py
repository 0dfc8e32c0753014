"""The tasks as functions of simulator truth, so that every episode can be labelled for every task.

P: ground-truth entries in the order of specs.GROUND_TRUTH_NAMES. Lengths in m.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.specs import GROUND_TRUTH_NAMES
from wm_nodes.core.types import BoolArray

GOAL_RADIUS_M = 0.1
"""ManiSkill's PushCube-v1 and PullCube-v1."""
CUBE_HALF_SIZE_M = 0.02
REACH_HEIGHT_M = 0.08
"""The reach target lies this far above the cube's centre, out of contact."""
REACH_TOLERANCE_M = 0.02

_INDEX = {name: i for i, name in enumerate(GROUND_TRUTH_NAMES)}
CUBE = slice(_INDEX["cube_x"], _INDEX["cube_z"] + 1)
TOOL = slice(_INDEX["tool_x"], _INDEX["tool_z"] + 1)
GOAL = slice(_INDEX["goal_x"], _INDEX["goal_y"] + 1)


@dataclass(frozen=True)
class Task:
    """instruction: what the text model reads. scene: the ManiSkill environment it happens in."""

    instruction: str
    scene: str
    success: Callable[[NDArray[np.float32]], BoolArray]


def _cube_in_goal(truth: NDArray[np.float32]) -> BoolArray:
    """ManiSkill's own rule: cube centre within the goal disc, still on the table. truth: (..., P)."""
    cube, goal = truth[..., CUBE], truth[..., GOAL]
    distance = np.linalg.norm(cube[..., :2] - goal, axis=-1)
    return np.asarray((distance < GOAL_RADIUS_M) & (cube[..., 2] < CUBE_HALF_SIZE_M + 5e-3))


def _tool_above_cube(truth: NDArray[np.float32]) -> BoolArray:
    return np.asarray(np.linalg.norm(truth[..., TOOL] - reach_target(truth), axis=-1) < REACH_TOLERANCE_M)


def reach_target(truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The point (..., 3) that the tool must reach: REACH_HEIGHT_M above the cube's centre."""
    return truth[..., CUBE] + np.array([0.0, 0.0, REACH_HEIGHT_M], np.float32)


TASKS: dict[str, Task] = {
    "reach": Task("move the gripper above the blue cube", "WmPushCube-v1", _tool_above_cube),
    "push_cube": Task("push the blue cube into the red target", "WmPushCube-v1", _cube_in_goal),
    "pull_cube": Task("pull the blue cube into the red target", "WmPullCube-v1", _cube_in_goal),
}


def instruction(task: str) -> str:
    return get_task(task).instruction


def success(task: str, ground_truth: NDArray[np.float32]) -> BoolArray:
    """Whether `task` is done in each (..., P) ground truth; False where it is NaN."""
    return get_task(task).success(ground_truth)


def get_task(name: str) -> Task:
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; choose one of {', '.join(TASKS)}")
    return TASKS[name]
