"""Boosted trees for yes-or-no questions, small enough to ship. NumPy only; weights are plain arrays, never a pickle.

Gradient boosting with second-order steps (Friedman 2001; Chen and Guestrin 2016) of oblivious trees: one question per
depth, the same in every branch, so that a tree is `depth` features and thresholds and 2^depth leaves. Shapes: N rows,
F features, M trees, D depth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, FloatArray

NUM_BINS = 32

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TreeSettings:
    """num_trees: M. depth: D. learning_rate: of each leaf. ridge: of leaf values, in units of the Hessian, which is at
    most a quarter per row. row_share, feature_share: drawn for each tree. All that stands between few rows and noise.
    """

    num_trees: int = 240
    depth: int = 4
    learning_rate: float = 0.1
    ridge: float = 2.0
    row_share: float = 0.7
    feature_share: float = 0.2

    def __post_init__(self) -> None:
        if self.num_trees < 1 or not 1 <= self.depth <= 8 or not 0 < self.learning_rate <= 1 or not self.ridge > 0:
            raise ValueError(f"need num_trees >= 1, depth 1 to 8, learning_rate in (0, 1], ridge > 0, got {self}")
        if not (0 < self.row_share <= 1 and 0 < self.feature_share <= 1):
            raise ValueError(f"row_share and feature_share must lie in (0, 1], got {self}")


@dataclass(frozen=True, eq=False)
class Trees:
    """features: int32 (M, D). thresholds: float32 (M, D), a row answers yes where it is above. leaves: float32
    (M, 2^D), the answer at depth d is bit d. gains: float32 (M, D), what each question was worth in training, >= 0.
    bias: log-odds before any tree.
    """

    features: NDArray[np.int32]
    thresholds: FloatArray
    leaves: FloatArray
    gains: FloatArray
    bias: float

    def log_odds(self, rows: FloatArray) -> FloatArray:
        """(N,) of rows (N, F)."""
        yes = rows[:, self.features] > self.thresholds
        leaf = yes @ (1 << np.arange(self.features.shape[1]))
        answers = self.leaves[np.arange(len(self.leaves)), leaf]
        odds: FloatArray = np.float32(self.bias) + answers.sum(1, dtype=np.float32)
        return odds

    def importance(self, num_features: int) -> FloatArray:
        """(F,), share of all gains that questions about a feature have."""
        total = np.bincount(self.features.ravel(), self.gains.ravel(), num_features)
        return (total / max(float(total.sum()), 1e-12)).astype(np.float32)


def fit_trees(
    rows: FloatArray, labels: BoolArray, weights: Floats, settings: TreeSettings, rng: np.random.Generator
) -> Trees:
    """Minimise the weighted logistic loss. rows: (N, F), finite. labels: bool (N,). weights: (N,), >= 0.

    Raises:
        ValueError: shapes differ, rows are not finite, or only one answer occurs.
    """
    if rows.ndim != 2 or labels.shape != (len(rows),) or weights.shape != labels.shape:
        raise ValueError(f"rows {rows.shape}, labels {labels.shape} and weights {weights.shape} do not belong together")
    if not np.isfinite(rows).all():
        raise ValueError("rows must be finite; evidence is by definition")
    if labels.all() or not labels.any():
        raise ValueError(f"all {len(labels)} labels are {bool(labels.any())}; a head needs both answers")
    edges = _edges(rows)
    bins = np.stack([np.searchsorted(edge, column) for edge, column in zip(edges, rows.T)]).astype(np.int64)  # (F, N)
    truth = labels.astype(np.float64)
    share = float((weights * truth).sum() / weights.sum())
    bias = float(np.log(share / (1 - share)))
    odds = np.full(len(rows), bias)
    features = np.zeros((settings.num_trees, settings.depth), np.int32)
    thresholds = np.zeros((settings.num_trees, settings.depth), np.float32)
    leaves = np.zeros((settings.num_trees, 2**settings.depth), np.float32)
    gains = np.zeros_like(thresholds)
    for m in range(settings.num_trees):
        p = 1 / (1 + np.exp(-odds))
        chosen = rng.random(len(rows)) < settings.row_share
        gradient, hessian = weights * (truth - p) * chosen, weights * p * (1 - p) * chosen
        asked = np.sort(rng.permutation(len(bins))[: max(1, round(settings.feature_share * len(bins)))])
        leaf = np.zeros(len(rows), np.int64)
        for depth in range(settings.depth):
            best, border, gains[m, depth] = _best_split(bins[asked], leaf, 2**depth, gradient, hessian, settings.ridge)
            feature = int(asked[best])
            features[m, depth] = feature
            thresholds[m, depth] = edges[feature][border] if border < len(edges[feature]) else np.inf
            leaf += (bins[feature] > border).astype(np.int64) << depth
        total = np.bincount(leaf, gradient, 2**settings.depth)
        mass = np.bincount(leaf, hessian, 2**settings.depth)
        leaves[m] = settings.learning_rate * total / (mass + settings.ridge)
        odds += leaves[m][leaf]
    return Trees(features, thresholds, leaves, gains, bias)


def _edges(rows: FloatArray) -> list[FloatArray]:
    """At most NUM_BINS - 1 borders per feature, between values that occur; one at the value where there is only one."""
    shares = np.linspace(0, 1, NUM_BINS + 1)[1:-1]
    edges = []
    for column in rows.T:
        values = np.unique(column)
        middle = (values[1:] + values[:-1]) / 2
        if len(middle) >= NUM_BINS:
            middle = np.unique(np.quantile(column, shares))
        edges.append((middle if len(middle) else values).astype(np.float32))
    return edges


def _best_split(
    bins: NDArray[np.int64], leaf: NDArray[np.int64], num_leaves: int, gradient: Floats, hessian: Floats, ridge: float
) -> tuple[int, int, float]:
    """The (feature, border) with the largest gain when every leaf is cut there, and that gain. bins: (F, N)."""
    count = len(bins)
    size = num_leaves * NUM_BINS
    place = (np.arange(count)[:, None] * size + leaf * NUM_BINS + bins).ravel()
    total, mass = (
        np.bincount(place, np.broadcast_to(values, bins.shape).ravel(), count * size)
        .reshape(count, num_leaves, NUM_BINS).cumsum(2)
        for values in (gradient, hessian)
    )
    below, above = total, total[:, :, -1:] - total
    gain = (below**2 / (mass + ridge) + above**2 / (mass[:, :, -1:] - mass + ridge)).sum(1)  # (F, NUM_BINS)
    before = float((total[0, :, -1] ** 2 / (mass[0, :, -1] + ridge)).sum())  # of the leaves as they are
    best = int(gain.argmax())
    return best // NUM_BINS, best % NUM_BINS, max(0.0, float(gain.flat[best]) - before)
