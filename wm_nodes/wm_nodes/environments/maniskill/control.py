"""Commands to ManiSkill's end-effector controllers, and what they now aim at. Shapes: A action, S state.

A state is in the robot's base frame: see core/action_spaces.py.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from wm_nodes.core.rotations import multiply, to_quaternion, to_vector
from wm_nodes.core.types import FloatArray

CONTROLLER_RANGE_M = 0.1
"""A full-scale action of ManiSkill's stock Panda controller."""
GRIPPER_CLOSED = -1.0
DOWN = np.array([0.0, 1.0, 0.0, 0.0])
"""Quaternion w x y z of the tool that points straight down."""
MAX_FINGER_M = 0.04


def rotation_of(quaternion: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """The rotation vector (3,) of a state, from a tool's quaternion (4,)."""
    rotation: NDArray[np.float64] = to_vector(np, multiply(np, quaternion, -DOWN))  # -DOWN is also DOWN's inverse
    return rotation


def quaternion_of(rotation: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """The inverse of rotation_of."""
    quaternion: NDArray[np.float64] = multiply(np, to_quaternion(np, rotation), DOWN)
    return quaternion


class ToolControl(ABC):
    """How a scene is commanded. control_mode, obs_mode: ManiSkill's."""

    control_mode: ClassVar[str]
    obs_mode: ClassVar[str]

    @abstractmethod
    def state(self, scene: BaseEnv) -> FloatArray:
        """What the controller aims at, (S,)."""

    @abstractmethod
    def step(self, scene: BaseEnv, state: FloatArray, target: FloatArray) -> FloatArray:
        """Let the controller aim at `target` (S,) instead of `state`, take a control step, and return the new state."""


class TranslationControl(ToolControl):
    control_mode, obs_mode = "pd_ee_target_delta_pos", "rgb"

    def state(self, scene: BaseEnv) -> FloatArray:
        position: FloatArray = scene.agent.controller.controllers["arm"]._target_pose.p[0].numpy()
        return position

    def step(self, scene: BaseEnv, state: FloatArray, target: FloatArray) -> FloatArray:
        command = np.append((target - state) / CONTROLLER_RANGE_M, GRIPPER_CLOSED).astype(np.float32)
        scene._step_action(torch.from_numpy(command)[None])
        return self.state(scene)


class PoseControl(ToolControl):
    """The controller is given its new target as such and a delta of zero.

    Its own deltas are at most 0.1 rad, are XYZ Euler angles and, in ManiSkill 3.0.1, are scaled by their lower limit: a
    rotation of +1 about an axis turns the tool by -0.1 rad.
    """

    control_mode, obs_mode = "pd_ee_target_delta_pose", "none"

    def state(self, scene: BaseEnv) -> FloatArray:
        pose = scene.agent.controller.controllers["arm"]._target_pose.raw_pose[0].numpy().astype(np.float64)
        gripper = scene.agent.robot.get_qpos()[0, -1].item() / MAX_FINGER_M * 2 - 1
        return np.array([*pose[:3], *rotation_of(pose[3:]), gripper], np.float32)

    def step(self, scene: BaseEnv, state: FloatArray, target: FloatArray) -> FloatArray:
        pose = np.concatenate([target[:3], quaternion_of(target[3:6])]).astype(np.float32)
        scene.agent.controller.controllers["arm"].set_state({"target_pose": torch.from_numpy(pose)[None]})
        command = np.array([*(0.0,) * 6, target[6]], np.float32)
        scene._step_action(torch.from_numpy(command)[None])
        return target


CONTROLS = {"translation": TranslationControl(), "pose": PoseControl()}
"""By Task.actions."""
