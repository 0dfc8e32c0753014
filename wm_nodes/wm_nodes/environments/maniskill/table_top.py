"""Ground truth of the scenes with a cube and a goal disc on a table. Lengths in m. P: GROUND_TRUTH_NAMES, in order."""

from typing import Any

import numpy as np

from wm_nodes.core.types import BoolArray, FloatArray

GROUND_TRUTH_NAMES = (
    "cube_x", "cube_y", "cube_z", "cube_yaw", "tool_x", "tool_y", "tool_z", "goal_x", "goal_y",
    "cube_start_x", "cube_start_y",
)
POSITIONS = {
    "object_x": "cube_x", "object_y": "cube_y", "tool_x": "tool_x", "tool_y": "tool_y", "tool_z": "tool_z",
    "goal_x": "goal_x", "goal_y": "goal_y",
}
"""What probes learn, see config/tasks.py: ModelPart."""
CUBE, TOOL, GOAL, CUBE_START = slice(0, 3), slice(4, 7), slice(7, 9), slice(9, 11)
GOAL_RADIUS_M = 0.1
"""ManiSkill's PushCube-v1 and PullCube-v1."""
CUBE_HALF_SIZE_M = 0.02
MAX_LIFT_M = 5e-3
HOVER_HEIGHT_M = 0.08
"""Above the cube's centre, out of contact."""


def measure(scene: Any, start: FloatArray | None) -> FloatArray:
    """Ground truth (P,) of a ManiSkill environment. start: that of the reset, None at the reset."""
    from transforms3d.euler import quat2euler

    cube = scene.obj.pose.raw_pose[0].numpy()
    goal = scene.goal_region.pose.p[0, :2].numpy()
    first = cube[:2] if start is None else start[CUBE_START]
    tool, yaw = scene.agent.tcp.pose.p[0].numpy(), quat2euler(cube[3:])[2]
    return np.asarray(np.concatenate([cube[:3], [yaw], tool, goal, first]), np.float32)


def cube_in_goal(truth: FloatArray) -> BoolArray:
    """ManiSkill's own rule: cube centre within the goal disc, still on the table. truth: (..., P)."""
    cube, goal = truth[..., CUBE], truth[..., GOAL]
    distance = np.linalg.norm(cube[..., :2] - goal, axis=-1)
    return np.asarray((distance < GOAL_RADIUS_M) & (cube[..., 2] < CUBE_HALF_SIZE_M + MAX_LIFT_M))


def above_cube(truth: FloatArray) -> FloatArray:
    """The point (..., 3) that is HOVER_HEIGHT_M above the cube's centre."""
    return truth[..., CUBE] + np.array([0.0, 0.0, HOVER_HEIGHT_M], np.float32)
