"""Intervals for success rates. All are 95 % by default and are written as (low, high)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.seeding import numpy_stream

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""


@dataclass(frozen=True)
class PairedDifference:
    """Success after minus success before, on the same seeds. low, high: Tango's score interval (1998).

    kept: succeeded both times. lost: only before. gained: only after. failed: never.
    mcnemar_p: exact two-sided binomial test of lost against gained.
    """

    episodes: int
    kept: int
    lost: int
    gained: int
    failed: int
    difference: float
    low: float
    high: float
    mcnemar_p: float


def wilson_interval(successes: float, episodes: float, *, z: float = Z_95) -> tuple[float, float]:
    """Return Wilson's score interval of a proportion; (0, 1) without episodes."""
    if not 0 <= successes <= episodes:
        raise ValueError(f"successes must lie in 0..episodes, got {successes} of {episodes}")
    if episodes == 0:
        return 0.0, 1.0
    share, scale = successes / episodes, z * z / episodes
    center = (share + scale / 2) / (1 + scale)
    half = z / (1 + scale) * math.sqrt(share * (1 - share) / episodes + scale / (4 * episodes))
    low = 0.0 if successes == 0 else max(0.0, center - half)
    return low, 1.0 if successes == episodes else min(1.0, center + half)


def newcombe_difference(
    successes: int, episodes: int, other_successes: int, other_episodes: int, *, z: float = Z_95
) -> tuple[float, float]:
    """Return the interval of p - p_other of two independent proportions (Newcombe 1998, hybrid score, method 10)."""
    if episodes == 0 or other_episodes == 0:
        return -1.0, 1.0
    p, q = successes / episodes, other_successes / other_episodes
    low, high = wilson_interval(successes, episodes, z=z)
    other_low, other_high = wilson_interval(other_successes, other_episodes, z=z)
    return p - q - math.hypot(p - low, other_high - q), p - q + math.hypot(high - p, q - other_low)


def bootstrap_mean(
    values: Sequence[float] | NDArray[Any], *, seed: int, draws: int = 10_000
) -> tuple[float, float, float]:
    """Return (mean, low, high): the mean of values and its 95 % percentile bootstrap interval over them."""
    array = np.asarray(values, np.float64)
    generator = numpy_stream(seed, "bootstrap", len(array))
    means = array[generator.integers(len(array), size=(draws, len(array)))].mean(1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(array.mean()), float(low), float(high)


def paired_difference(before: Sequence[bool], after: Sequence[bool], *, z: float = Z_95) -> PairedDifference:
    """Compare two binary results on the same seeds, in the same order.

    Raises:
        ValueError: lengths differ or are 0.
    """
    first, second = np.asarray(before, np.bool_), np.asarray(after, np.bool_)
    if first.shape != second.shape or first.ndim != 1 or len(first) == 0:
        raise ValueError(f"before and after must be equally long and not empty, got {first.shape} and {second.shape}")
    kept, failed = int((first & second).sum()), int((~first & ~second).sum())
    lost, gained = int((first & ~second).sum()), int((~first & second).sum())
    episodes = len(first)
    low, high = _tango_interval(gained, lost, episodes, z)
    return PairedDifference(
        episodes, kept, lost, gained, failed, (gained - lost) / episodes, low, high, mcnemar_exact(gained, lost)
    )


def mcnemar_exact(gained: int, lost: int) -> float:
    """Return the two-sided exact p: twice the smaller binomial(1/2) tail of the discordant pairs, at most 1."""
    discordant = gained + lost
    tail = sum(math.comb(discordant, k) for k in range(min(gained, lost) + 1))
    return min(1.0, 2 * tail / (1 << discordant))


def _tango_interval(gained: int, lost: int, episodes: int, z: float) -> tuple[float, float]:
    """Invert Tango's score test: all differences whose |score| is at most z."""
    difference = (gained - lost) / episodes

    def edge(outside: float) -> float:
        inside = difference
        if abs(_tango_score(gained, lost, episodes, outside)) <= z:
            return outside
        for _ in range(100):
            middle = (inside + outside) / 2
            if abs(_tango_score(gained, lost, episodes, middle)) <= z:
                inside = middle
            else:
                outside = middle
        return inside

    return edge(-1.0), edge(1.0)


def _tango_score(gained: int, lost: int, episodes: int, difference: float) -> float:
    """Score of H: p_gained - p_lost = difference, with p_lost at its constrained maximum likelihood."""
    a = 2.0 * episodes
    b = -gained - lost + (2 * episodes - gained + lost) * difference
    c = -lost * difference * (1 - difference)
    p_lost = (math.sqrt(max(b * b - 4 * a * c, 0.0)) - b) / (2 * a)
    variance: float = episodes * (2 * p_lost + difference * (1 - difference))
    numerator = gained - lost - episodes * difference
    if variance <= 1e-12:
        return 0.0 if abs(numerator) < 1e-12 else math.copysign(math.inf, numerator)
    return numerator / math.sqrt(variance)
