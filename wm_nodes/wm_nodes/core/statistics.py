"""Intervals for success rates, and how well a judge's answers match known labels (RA-24). Shapes: N labelled decisions.

Intervals are of 95 % by default and are written as (low, high). Of answers, True is a pass; a decision that nobody made
is left out before these functions are called.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import BoolArray

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""
T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)
"""97.5 % quantile of Student's t for 1 to 9 degrees of freedom; the last serves more of them, a little wide."""
NAN = float("nan")


@dataclass(frozen=True)
class MeanInterval:
    """Of a few values, such as the seeds' difference of one measure."""

    mean: float
    """Of the values."""
    low: float
    """Of Student's 95 % interval."""
    high: float
    """Of Student's 95 % interval."""

    @property
    def separable(self) -> bool:
        return not self.low <= 0 <= self.high


@dataclass(frozen=True)
class PairedDifference:
    """Success after minus success before, on the same seeds."""

    episodes: int
    """Pairs compared."""
    kept: int
    """Succeeded both times."""
    lost: int
    """Succeeded only before."""
    gained: int
    """Succeeded only after."""
    failed: int
    """Never succeeded."""
    difference: float
    """Success rate after minus success rate before."""
    low: float
    """Lower end of Tango's score interval (1998) of the difference."""
    high: float
    """Upper end of that interval."""
    mcnemar_p: float
    """p of the exact two-sided binomial test of lost against gained."""


def t_interval(values: Sequence[float]) -> MeanInterval:
    """Return mean -+ t s / sqrt(n), s with n - 1. Raises ValueError: fewer than two values."""
    n = len(values)
    if n < 2:
        raise ValueError(f"an interval needs at least two values, got {n}; train more seeds")
    mean, spread = float(np.mean(values)), float(np.std(values, ddof=1))
    half = t_975(n - 1) * spread / math.sqrt(n)
    return MeanInterval(mean, mean - half, mean + half)


def t_975(freedom: int) -> float:
    """97.5 % quantile of Student's t, see T_975."""
    return T_975[min(freedom, len(T_975)) - 1]


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


def bootstrap_ratio(
    top: ArrayLike, bottom: ArrayLike, groups: NDArray[np.int64], *, seed: int, draws: int = 2_000
) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of mean(top) / mean(bottom) over groups of pairs, a number for each
    pair; NaN without pairs, or where bottom is 0."""
    _, of_pair = np.unique(groups, return_inverse=True)
    above, below = (np.bincount(of_pair, np.asarray(values, np.float64)) for values in (top, bottom))
    if not len(above):
        return NAN, NAN
    rows = numpy_stream(seed, "bootstrap_ratio", len(above)).integers(len(above), size=(draws, len(above)))
    means = below[rows].mean(1)
    if not (means > 0).all():
        return NAN, NAN
    low, high = np.quantile(above[rows].mean(1) / means, (0.025, 0.975))
    return float(low), float(high)


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


def balanced_accuracy(labels: ArrayLike, answers: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Mean of the share of passes that are called passes and the share of fails that are called fails.

    Args:
        labels, answers: bool (N,). weights: (N,), what each decision stands for; 1 by default.

    Returns:
        In [0, 1]; 0.5 for an answer that ignores the clip. NaN where the labels are all passes or all fails.
    """
    truth, passed, weight = _align(labels, answers, weights)
    return float((_share(passed[truth], weight[truth]) + _share(~passed[~truth], weight[~truth])) / 2)


def kappa(
    first: Sequence[Hashable], second: Sequence[Hashable], *, weighting: Literal["none", "quadratic"] = "none"
) -> float:
    """Cohen's kappa (1960): agreement of two raters beyond what their own frequencies make of chance.

    kappa = 1 - sum w_ij o_ij / sum w_ij e_ij with w = 1 off the diagonal, or (i - j)^2 for ordered levels (quadratic).

    Returns:
        At most 1; 0 at chance. NaN where nothing could disagree: no ratings, or one category throughout.

    Raises:
        ValueError: lengths differ.
    """
    if len(first) != len(second):
        raise ValueError(f"two raters must rate the same things, got {len(first)} and {len(second)} ratings")
    categories = sorted({*first, *second}, key=lambda value: (str(type(value)), value))
    at = {category: index for index, category in enumerate(categories)}
    observed = np.zeros((len(categories), len(categories)))
    for one, other in zip(first, second):
        observed[at[one], at[other]] += 1
    if weighting == "quadratic":
        values = np.array([float(value) for value in categories])  # type: ignore[arg-type]
        disagreement = (values[:, None] - values[None, :]) ** 2
    else:
        disagreement = 1 - np.eye(len(categories))
    expected = np.outer(observed.sum(1), observed.sum(0)) / max(1, len(first))
    chance = float((disagreement * expected).sum())
    return 1 - float((disagreement * observed).sum()) / chance if chance > 0 else NAN


def expected_calibration_error(
    labels: ArrayLike, p_pass: ArrayLike, weights: ArrayLike | None = None, *, num_bins: int = 10
) -> float:
    """ECE = sum_b n_b / n |mean p_pass - share of passes| over bins of equal width in [0, 1]; NaN without decisions.

    Args:
        labels: bool (N,). p_pass: (N,), probability that the judge gives to a pass.

    Raises:
        ValueError: lengths differ, or a probability is outside [0, 1].
    """
    truth, probability = np.asarray(labels, np.bool_), np.asarray(p_pass, np.float64)
    _, _, weight = _align(truth, truth, weights)
    if probability.shape != truth.shape or not ((probability >= 0) & (probability <= 1)).all():
        raise ValueError(f"p_pass must hold {len(truth)} probabilities in [0, 1], got {probability}")
    if len(truth) == 0:
        return NAN
    bins = np.minimum((probability * num_bins).astype(int), num_bins - 1)
    gaps = np.bincount(bins, weight * (probability - truth), num_bins)
    return float(np.abs(gaps).sum() / weight.sum())


def auroc(labels: ArrayLike, scores: ArrayLike) -> float:
    """P(score of a pass > score of a fail), ties counted half; NaN where the labels are all passes or all fails.

    Raises:
        ValueError: lengths differ, or a score is NaN.
    """
    truth, values = np.asarray(labels, np.bool_), np.asarray(scores, np.float64)
    if truth.shape != values.shape or truth.ndim != 1 or np.isnan(values).any():
        raise ValueError(f"auroc needs one score per label and no NaN, got {values.shape} for {truth.shape}")
    passes, fails = int(truth.sum()), int((~truth).sum())
    if not passes or not fails:
        return NAN
    _, index, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - (counts - 1) / 2)[index]
    return float((ranks[truth].sum() - passes * (passes + 1) / 2) / (passes * fails))


def effective_size(weights: ArrayLike) -> float:
    """Kish's (sum w)^2 / sum w^2: how many equally weighted decisions tell as much; 0 without any."""
    values = np.asarray(weights, np.float64)
    squares = float((values**2).sum())
    return float(values.sum()) ** 2 / squares if squares else 0.0


def wilson_of_groups(correct: BoolArray, groups: NDArray[np.int64]) -> tuple[float, float, float]:
    """Return (share, low, high): a share of decisions and its 95 % Wilson interval at the number of groups, as if those
    of one group were a single one; (NaN, 0, 1) without any."""
    size = len(np.unique(groups))
    if size == len(groups):
        return wilson_of_share(correct)
    share = float(correct.mean())
    return (share, *wilson_interval(share * size, size))


def wilson_of_share(correct: ArrayLike, weights: ArrayLike | None = None) -> tuple[float, float, float]:
    """Return (share, low, high): a weighted share and its 95 % Wilson interval at the effective size.

    With equal weights this is Wilson's interval; with unequal ones an approximation that ignores what a stratified
    sample gains over a random one.
    """
    right, _, weight = _align(correct, correct, weights)
    if weights is None:
        return (_share(right, weight), *wilson_interval(int(right.sum()), len(right)))
    share, size = _share(right, weight), effective_size(weight)
    return (share, *wilson_interval(share * size, size)) if size else (NAN, 0.0, 1.0)


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


def _share(chosen: NDArray[np.bool_], weight: NDArray[np.float64]) -> float:
    total = float(weight.sum())
    return min(1.0, float(weight[chosen].sum()) / total) if total else NAN


def _align(
    labels: ArrayLike, answers: ArrayLike, weights: ArrayLike | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[Any]]:
    truth, passed = np.asarray(labels, np.bool_), np.asarray(answers, np.bool_)
    weight = np.ones(len(truth)) if weights is None else np.asarray(weights, np.float64)
    if truth.ndim != 1 or truth.shape != passed.shape or truth.shape != weight.shape or not (weight >= 0).all():
        raise ValueError(
            f"labels, answers and weights >= 0 must be rows of one length, got {truth.shape}, {passed.shape} and "
            f"{weight.shape}"
        )
    return truth, passed, weight
