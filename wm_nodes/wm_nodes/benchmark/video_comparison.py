"""Two ways of training, compared on the same seeds: mean paired difference with Student's 95 % interval."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wm_nodes.rl.hacking import T_975

MEASURES = ("reward_path", "reward", "obeyed", "background")
"""reward_path: mean held-out reward over the evaluations of a training, its area per model call; the others: at its
end."""


@dataclass(frozen=True)
class Difference:
    """Mean and 95 % interval of arm - base over `seeds`, for one measure."""

    mean: float
    low: float
    high: float

    @property
    def separable(self) -> bool:
        return not self.low <= 0 <= self.high


@dataclass(frozen=True)
class Comparison:
    """arm against base on their common seeds; differences: one per measure."""

    arm: str
    base: str
    seeds: tuple[int, ...]
    differences: dict[str, Difference]


def compare_arms(rows: Sequence[dict[str, Any]], arm: str, base: str) -> Comparison | None:
    """Compare the rows of train_arm; None where the two have fewer than two seeds in common."""
    of = {name: {row["seed"]: row for row in rows if row["arm"] == name} for name in (arm, base)}
    seeds = sorted(of[arm].keys() & of[base].keys())
    if len(seeds) < 2:
        return None
    differences = {
        measure: paired_interval([value(of[arm][seed], measure) - value(of[base][seed], measure) for seed in seeds])
        for measure in MEASURES
    }
    return Comparison(arm, base, tuple(seeds), differences)


def value(row: dict[str, Any], measure: str) -> float:
    """One number of one training, see MEASURES."""
    evaluations = row["evaluations"]
    if measure == "reward_path":
        return float(np.mean([evaluation["reward"] for evaluation in evaluations[1:]]))
    return float(evaluations[-1][measure])


def paired_interval(differences: Sequence[float]) -> Difference:
    """Return mean -+ t s / sqrt(n), s with n - 1.

    Raises:
        ValueError: fewer than two differences.
    """
    n = len(differences)
    if n < 2:
        raise ValueError(f"an interval needs at least two pairs, got {n}; train more seeds")
    mean, spread = float(np.mean(differences)), float(np.std(differences, ddof=1))
    half = T_975[min(n - 1, len(T_975)) - 1] * spread / math.sqrt(n)
    return Difference(mean, mean - half, mean + half)
