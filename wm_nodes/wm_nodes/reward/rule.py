"""The simulator's own success as reward: the control beside the endogenous one. Shapes: N environments."""

import numpy as np

from wm_nodes.reward.base import (
    SUCCESS_NO,
    SUCCESS_UNKNOWN,
    SUCCESS_YES,
    RewardInput,
    RewardResult,
    assemble,
    version_of,
)


class RuleReward:
    """Pays sparse_weight on the step that reaches success (success_probability 1 in a simulator), else 0."""

    def __init__(self, sparse_weight: float = 1.0) -> None:
        if not (np.isfinite(sparse_weight) and sparse_weight >= 0):
            raise ValueError(f"sparse_weight must be finite and >= 0, got {sparse_weight}")
        self._weight = sparse_weight

    @property
    def name(self) -> str:
        return "rule"

    @property
    def version(self) -> int:
        return version_of(self.name, repr(self._weight))

    def evaluate(self, step: RewardInput) -> RewardResult:
        unknown = ~np.isfinite(step.success_probability)
        reached = step.success_probability > 0.5
        success = np.where(unknown, SUCCESS_UNKNOWN, np.where(reached, SUCCESS_YES, SUCCESS_NO)).astype(np.uint8)
        return assemble(
            np.zeros(len(reached), np.float32), np.float32(self._weight) * reached.astype(np.float32), step, success,
            {"success probability is not finite": unknown}, {"dense": 0.0, "sparse": self._weight},
        )
