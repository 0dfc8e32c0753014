"""Plot-friendly numbers over the rewards since the last summary. Shapes: N environments."""

from collections import defaultdict

import numpy as np

from wm_nodes.core.lockstep import LockStep
from wm_nodes.reward import RewardResult

EPISODES_KEPT = 2**15
"""Episodes that have begun and not ended; more than environments exist are of no use."""


class SummaryWindow:
    """Collects rewards until take()."""

    def __init__(self) -> None:
        self.invalid = 0
        self._returns: dict[int, float] = defaultdict(float)
        self._clear()

    def add(self, transition: LockStep, result: RewardResult) -> None:
        """Count one judged lock-step."""
        valid = result.valid
        self.invalid += int((transition.valid & ~valid).sum())
        self._totals.append(result.total[valid])
        self._dense.append(result.dense[valid])
        self._sparse.append(result.sparse[valid])
        for i in np.flatnonzero(valid):
            self._returns[int(transition.episode_ids[i])] += float(result.total[i])
        while len(self._returns) > EPISODES_KEPT:
            del self._returns[next(iter(self._returns))]
        for i in np.flatnonzero(transition.valid & (transition.terminated | transition.truncated)):
            self._ended_returns.append(self._returns.pop(int(transition.episode_ids[i]), 0.0))
            self._lengths.append(int(transition.episode_steps[i]) + 1)
            self._successes += int(transition.terminated[i])

    def take(self) -> dict[str, float | int] | None:
        """Return the fields of RewardSummary and start again; None when nothing was judged."""
        totals = np.concatenate(self._totals) if self._totals else np.empty(0, np.float32)
        if not totals.size:
            return None
        episodes = len(self._ended_returns)
        values: dict[str, float | int] = {
            "mean_total": float(totals.mean()),
            "mean_dense": float(np.concatenate(self._dense).mean()),
            "mean_sparse": float(np.concatenate(self._sparse).mean()),
            "min_total": float(totals.min()),
            "max_total": float(totals.max()),
            "success_rate": self._successes / episodes if episodes else float("nan"),
            "episodes": episodes,
            "mean_return": float(np.mean(self._ended_returns)) if episodes else float("nan"),
            "mean_length": float(np.mean(self._lengths)) if episodes else float("nan"),
            "invalid": self.invalid,
        }
        self._clear()
        return values

    def forget_episodes(self) -> None:
        """Episode ids start again: unfinished returns belong to nobody."""
        self._returns.clear()

    def _clear(self) -> None:
        self.invalid = 0
        self._totals: list[np.ndarray[tuple[int], np.dtype[np.float32]]] = []
        self._dense: list[np.ndarray[tuple[int], np.dtype[np.float32]]] = []
        self._sparse: list[np.ndarray[tuple[int], np.dtype[np.float32]]] = []
        self._ended_returns: list[float] = []
        self._lengths: list[int] = []
        self._successes = 0
