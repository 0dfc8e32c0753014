"""An arm that nothing in the product knows: six joints with measured positions, one camera of 96 x 72 px, no simulator
truth, no task file, and resets that take no seeds. Success is the flag that it says itself."""

import numpy as np
import torch

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.tool_control import check_actions
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
HEIGHT_PX, WIDTH_PX = 72, 96
GOAL_RAD, NEAR_RAD = np.array([0.5, -0.3], np.float32), 0.35
"""The first two joints have to come so near to these positions."""
FOLLOWS = 0.7
"""Share of a commanded change that the joints make: their positions are measured, not commanded."""


class ForeignArm:
    """Coloured squares, one for each pair of joints, stand where their positions say."""

    def __init__(self, num_envs: int, seed: int, max_episode_steps: int = 8) -> None:
        self.spec = EnvironmentSpec(
            env_id="lab/six_joint_arm", task="touch_the_post", instruction="touch the post", source=SOURCE_REAL,
            num_envs=num_envs, height=HEIGHT_PX, width=WIDTH_PX, cameras=("overview",),
            action_names=tuple(f"{joint}.change" for joint in JOINTS), action_units=("rad",) * 6,
            action_scale=(0.25,) * 6, state_names=tuple(f"{joint}.pos" for joint in JOINTS),
            state_units=("rad",) * 6, ground_truth_names=(), control_period_s=0.1, max_episode_steps=max_episode_steps,
        )
        self._seed, self._resets = seed, 0
        self._joints = np.zeros((num_envs, 6), np.float32)
        self._steps, self._ids = np.zeros(num_envs, np.uint32), np.zeros(num_envs, np.uint64)
        self._ended = np.ones(num_envs, bool)

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        for env in range(self.spec.num_envs) if mask is None else np.flatnonzero(mask):
            self._resets += 1
            self._joints[env] = numpy_stream(self._seed, "arm", self._resets).uniform(-0.6, 0.6, 6)
            self._steps[env], self._ids[env], self._ended[env] = 0, self._resets, False
        return self._observation()

    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        valid, scale = ~self._ended, np.float32(FOLLOWS * self.spec.action_scale[0])
        self._joints = np.where(valid[:, None], np.clip(self._joints + scale * actions, -1, 1), self._joints)
        self._steps = self._steps + valid.astype(np.uint32)
        touches = np.linalg.norm(self._joints[:, :2] - GOAL_RAD, axis=1) < NEAR_RAD
        terminated = touches & valid
        truncated = valid & ~touches & (self._steps >= self.spec.max_episode_steps)
        self._ended = self._ended | terminated | truncated
        count = self.spec.num_envs
        return StepResult(
            self._observation(), terminated, truncated, touches.astype(np.float32), np.zeros(count, np.float32),
            np.zeros((count, 0), np.float32), valid,
        )

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        self._ended[:] = True

    def _observation(self) -> Observation:
        images = np.full((self.spec.num_envs, HEIGHT_PX, WIDTH_PX, 3), 40, np.uint8)
        room = np.array([HEIGHT_PX, WIDTH_PX]) - 16
        for env, pairs in enumerate(self._joints.reshape(-1, 3, 2)):
            for channel, (row, column) in enumerate(((pairs + 1) / 2 * room).astype(int)):
                images[env, row : row + 16, column : column + 16, channel] = 255
        return Observation(images, self._joints.copy(), self._ids.copy(), self._steps.copy())


def make_environment(config: RunConfig, num_envs: int, seed: int) -> ForeignArm:
    return ForeignArm(num_envs, seed)


def make_policy(config: RunConfig) -> ImagePolicy:
    """Acts at random: what a first recording needs, before there is a model whose tokenizer a policy could see by."""
    encoder = ImageEncoder(lambda images: images[:, ::18, ::24].float().flatten(1) / 255, 4 * 4 * 3)
    torch.set_num_threads(1)
    small = config.policy.with_values(width=16, depth=1, projection=8)
    return ImagePolicy(encoder, len(JOINTS), len(JOINTS), small, seed=config.seed)
