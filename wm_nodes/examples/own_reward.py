"""A reward of your own; see reward/base.py.

python -m wm_nodes.policy_rl.train --reward.factory examples.own_reward:make
    --preset smoke --updates 3 --ppo.num_steps 16
"""
import numpy as np

from wm_nodes.config.schema import RunConfig
from wm_nodes.reward.base import SUCCESS_NO, SUCCESS_YES, RewardInput, RewardResult, assemble, version_of


class HurriedReward:
    """Pays success, and every step costs."""

    name = "hurried"

    def __init__(self, cost: float, threshold: float) -> None:
        self._cost, self._threshold = cost, threshold
        self.version = version_of(self.name, repr(cost), repr(threshold))

    def evaluate(self, step: RewardInput) -> RewardResult:
        reached = step.success_probability > self._threshold
        cost = np.full(len(reached), -self._cost, np.float32)
        success = np.where(reached, SUCCESS_YES, SUCCESS_NO).astype(np.uint8)
        unknown = {"success is not known": ~np.isfinite(step.success_probability)}
        return assemble(cost, reached.astype(np.float32), step, success, unknown, {"dense": self._cost, "sparse": 1.0})


def make(config: RunConfig) -> HurriedReward:
    return HurriedReward(0.02, config.reward.success_threshold)
