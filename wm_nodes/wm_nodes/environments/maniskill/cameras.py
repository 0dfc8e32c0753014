"""The cameras of the table-top scenes, for who renders them and for who only says where they are. No simulator."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from transforms3d.quaternions import quat2mat

from wm_nodes.config.environments import SimulationConfig
from wm_nodes.core.cameras import CameraModel, Matrix, intrinsics, look_at
from wm_nodes.core.rotations import to_quaternion
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE

TOOL_BELOW_HAND_M = 0.1034
"""From the Panda's link panda_hand to panda_hand_tcp."""


@dataclass(frozen=True)
class Placement:
    """Where a camera is: in the world frame, or in that of the link panda_hand."""

    eye: tuple[float, float, float]
    """m."""
    target: tuple[float, float, float]
    """That it looks at, m."""
    fov_rad: float
    """Vertical field of view."""
    on_hand: bool = False
    """It moves with the hand."""


PLACEMENTS = {
    "side": Placement(eye=(0.09, 0.5, 0.45), target=(0.09, -0.01, 0.02), fov_rad=0.8),
    "near": Placement(eye=(0.42, 0.0, 0.38), target=(-0.02, 0.0, 0.03), fov_rad=0.85),
    "front": Placement(eye=(0.36, 0.0, 0.42), target=(0.01, 0.0, 0.02), fov_rad=0.74),
    "wrist": Placement(eye=(0.06, 0.0, 0.0), target=(0.03, 0.0, 0.12), fov_rad=1.4, on_hand=True),
}


def table_top_cameras(config: SimulationConfig, hand: Callable[[int], Matrix]) -> tuple[CameraModel, ...]:
    """The cameras of config.cameras.

    Args:
        hand: environment 0 to N - 1 -> pose (4, 4) of the link panda_hand in the robot's base frame.
    """

    def on_hand(local: Matrix) -> Callable[[int], Matrix]:
        return lambda env: hand(env) @ local

    models = []
    for name in config.cameras:
        placement, size = PLACEMENTS[name], config.image_size
        pose: Any = look_at(placement.eye, placement.target)
        if placement.on_hand:
            pose = on_hand(pose)
        else:
            pose[:3, 3] -= ROBOT_BASE
        models.append(CameraModel(name, size, size, intrinsics(size, size, placement.fov_rad), pose))
    return tuple(models)


def hand_over(state: Any) -> Matrix:
    """Pose (4, 4) of the link panda_hand behind a commanded tool (S,) in the robot's base frame: a position, which the
    hand points straight down at, or a pose.

    Of a position, the simulator's arm starts up to a few hundredths of a radian off (ManiSkill's reset noise) and keeps
    that angle.
    """
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    if len(state) > 3:
        pose[:3, :3] = quat2mat(to_quaternion(np, state[3:6])) @ pose[:3, :3]
    pose[:3, 3] = state[:3] - TOOL_BELOW_HAND_M * pose[:3, 2]
    return pose
