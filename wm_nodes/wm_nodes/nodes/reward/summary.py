"""Plot-friendly numbers over the rewards since the last summary. Shapes: N environments."""

import math
from collections import defaultdict

import numpy as np

from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.types import FloatArray
from wm_nodes.reward import RewardResult

EPISODES_KEPT = 2**15
"""Episodes that have begun and not ended; more than environments exist are of no use."""


class SummaryWindow:
    """Collects rewards until take()."""

    def __init__(self) -> None:
        self.invalid = 0
        """Steps that were made and have no reward."""
        self._returns: dict[int, float] = defaultdict(float)
        self._rewards: list[FloatArray] = []
        self._ended: list[tuple[float, int, bool]] = []

    def add(self, step: LockStep, result: RewardResult) -> None:
        """Count one judged lock-step."""
        self.invalid += int((step.valid & ~result.valid).sum())
        if result.valid.any():
            self._rewards.append(np.stack([result.total, result.dense, result.sparse])[:, result.valid])
        for i in np.flatnonzero(result.valid):
            self._returns[int(step.episode_ids[i])] += float(result.total[i])
        while len(self._returns) > EPISODES_KEPT:
            del self._returns[next(iter(self._returns))]
        for i in np.flatnonzero(step.valid & step.ended):
            gained = self._returns.pop(int(step.episode_ids[i]), 0.0)
            self._ended.append((gained, int(step.episode_steps[i]) + 1, bool(step.success[i])))

    def take(self) -> dict[str, float | int] | None:
        """Return the fields of RewardSummary and start again; None when no step was made. Means, minimum and maximum
        are NaN where not one of the steps has a reward."""
        rewards = np.concatenate([np.empty((3, 0), np.float32), *self._rewards], 1)
        if not rewards.size and not self.invalid:
            return None
        total, dense, sparse = rewards if rewards.size else np.full((3, 1), np.nan, np.float32)
        returns, lengths, successes = zip(*self._ended, strict=True) if self._ended else ((math.nan,),) * 3
        values: dict[str, float | int] = {
            "mean_total": float(total.mean()), "mean_dense": float(dense.mean()), "mean_sparse": float(sparse.mean()),
            "min_total": float(total.min()), "max_total": float(total.max()),
            "success_rate": float(np.mean(successes)), "episodes": len(self._ended),
            "mean_return": float(np.mean(returns)), "mean_length": float(np.mean(lengths)), "invalid": self.invalid,
        }
        self.invalid, self._rewards, self._ended = 0, [], []
        return values

    def forget_episodes(self) -> None:
        """Episode ids start again: unfinished returns belong to nobody."""
        self._returns.clear()
