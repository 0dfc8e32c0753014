"""An arm of your own, here one that a few lines simulate; see environments/batch.py and core/specs.py.

python -m wm_nodes.policy_rl.train --task "" --environment.factory examples.own_environment:make
    --policy.factory wm_nodes.policy_rl.factories:untrained_policy --preset smoke --ppo.num_steps 16 --updates 3
"""
import numpy as np

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.specs import SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.batch import EnvironmentBatch, Frame

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
SPEC = EnvironmentSpec(
    env_id="lab/six_joint_arm", task="touch_the_post", instruction="touch the post", source=SOURCE_REAL, num_envs=1,
    height=72, width=96, cameras=("overview",), action_names=tuple(f"{joint}.change" for joint in JOINTS),
    action_units=("rad",) * 6, action_scale=(0.25,) * 6, state_names=tuple(f"{joint}.pos" for joint in JOINTS),
    state_units=("rad",) * 6, ground_truth_names=(), control_period_s=0.1, max_episode_steps=8,
)


class Arm:
    def reset(self, seed: int) -> Frame:
        self._joints = np.random.default_rng(seed).uniform(-0.6, 0.6, 6)
        return self.step(np.zeros(6, np.float32))

    def step(self, action: FloatArray) -> Frame:
        self._joints = np.clip(self._joints + 0.7 * SPEC.action_scale[0] * action, -1, 1)  # 70 % of what is commanded
        image = np.full((SPEC.height, SPEC.width, 3), 40, np.uint8)  # a square for each pair of joints
        for channel, (row, column) in enumerate(((self._joints.reshape(3, 2) + 1) / 2 * (56, 80)).astype(int)):
            image[row : row + 16, column : column + 16, channel] = 255
        touches = np.linalg.norm(self._joints[:2] - (0.5, -0.3)) < 0.35
        return Frame(image, self._joints.astype(np.float32), success=bool(touches))

    def hold(self) -> None: ...  # it stays by itself; left out, action 0 must mean that: changes, no absolute commands
    def close(self) -> None: ...


def make(config: RunConfig, num_envs: int, seed: int) -> EnvironmentBatch:
    return EnvironmentBatch(SPEC, [Arm()], seed)  # a real robot has num_envs 1, however many are asked for
