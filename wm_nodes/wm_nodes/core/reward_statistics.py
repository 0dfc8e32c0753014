"""How well a judge's answers match known labels (RA-24). Shapes: N labelled decisions.

True is a pass. A decision that nobody made is left out before these functions are called.
"""

from collections.abc import Hashable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wm_nodes.core.statistics import wilson_interval

__all__ = [
    "auroc",
    "balanced_accuracy",
    "effective_size",
    "expected_calibration_error",
    "kappa",
    "recall_at",
    "wilson_interval",
    "wilson_of_share",
]

NAN = float("nan")


def balanced_accuracy(labels: ArrayLike, answers: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Mean of the share of passes that are called passes and the share of fails that are called fails.

    Args:
        labels, answers: bool (N,). weights: (N,), what each decision stands for; 1 by default.

    Returns:
        In [0, 1]; 0.5 for an answer that ignores the clip. NaN where the labels are all passes or all fails.
    """
    truth, said, weight = _aligned(labels, answers, weights)
    return float((_share(said[truth], weight[truth]) + _share(~said[~truth], weight[~truth])) / 2)


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
    _, _, weight = _aligned(truth, truth, weights)
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


def recall_at(present: ArrayLike, scores: ArrayLike, false_positives: float) -> float:
    """The largest share of present ones above a threshold that at most a share of the others exceeds; NaN without both.

    Args:
        present: bool (N,). scores: (N,), higher where something is thought to be there. false_positives: in [0, 1).
    """
    there, values = np.asarray(present, np.bool_), np.asarray(scores, np.float64)
    mine, others = values[there], np.sort(values[~there])[::-1]
    if not len(mine) or not len(others):
        return NAN
    return float((mine > others[int(false_positives * len(others))]).mean())


def effective_size(weights: ArrayLike) -> float:
    """Kish's (sum w)^2 / sum w^2: how many equally weighted decisions tell as much; 0 without any."""
    values = np.asarray(weights, np.float64)
    squares = float((values**2).sum())
    return float(values.sum()) ** 2 / squares if squares else 0.0


def wilson_of_share(correct: ArrayLike, weights: ArrayLike | None = None) -> tuple[float, float, float]:
    """Return (share, low, high): a weighted share and its 95 % Wilson interval at the effective size.

    With equal weights this is Wilson's interval; with unequal ones an approximation that ignores what a stratified
    sample gains over a random one.
    """
    right, _, weight = _aligned(correct, correct, weights)
    if weights is None:
        return (_share(right, weight), *wilson_interval(int(right.sum()), len(right)))
    share, size = _share(right, weight), effective_size(weight)
    return (share, *wilson_interval(share * size, size)) if size else (NAN, 0.0, 1.0)


def _share(chosen: NDArray[np.bool_], weight: NDArray[np.float64]) -> float:
    total = float(weight.sum())
    return min(1.0, float(weight[chosen].sum()) / total) if total else NAN


def _aligned(
    labels: ArrayLike, answers: ArrayLike, weights: ArrayLike | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[Any]]:
    truth, said = np.asarray(labels, np.bool_), np.asarray(answers, np.bool_)
    weight = np.ones(len(truth)) if weights is None else np.asarray(weights, np.float64)
    if truth.ndim != 1 or truth.shape != said.shape or truth.shape != weight.shape or not (weight >= 0).all():
        raise ValueError(
            f"labels, answers and weights >= 0 must be rows of one length, got {truth.shape}, {said.shape} and "
            f"{weight.shape}"
        )
    return truth, said, weight
