"""Fit the heads of the embedded judge to labels, and measure them (RA-18 to RA-20).

Trees are fitted on the training part; the calibration of their log-odds and the limit beyond which a clip is out of
distribution, on the validation part. Shapes: N clips, F evidence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.statistics import auroc, balanced_accuracy, expected_calibration_error, recall_at, wilson_of_share
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.judge.agent.levels import p_fail_of
from wm_nodes.judge.agent.types import PLANNING
from wm_nodes.judge.dataset.edits.clips import COMPONENTS, TC
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.dataset.edits.planning import planning_level
from wm_nodes.judge.evidence.head import (
    CLIP_AT,
    HACK,
    SHARPNESS,
    Familiarity,
    HeadQuestion,
    above_levels,
    levels_of,
    num_questions,
)
from wm_nodes.judge.evidence.trees import TreeSettings, fit_trees

PATTERNS = ("occlusion", "motion", "background", "physics")
TARGETS = (*COMPONENTS, TC, PLANNING, *(HACK + name for name in PATTERNS))
UNKNOWN = -1
SHRINKAGE = 0.3
"""Share of the identity in the covariance of standardised evidence."""
COVERAGE = 0.99
"""Share of the validation part that counts as in distribution."""
MIN_SLOPE, MAX_SLOPE = 0.1, 3.0
FLAG, MAX_FALSE_FLAGS = 0.8, 0.02
"""The agent confirms a pattern from this probability on (rubrics: hack.confirm)."""
CONFORMAL = (0.8, 0.9, 0.95, 0.98)
"""Coverages whose limits are saved with a judge."""
LAST_FAIL = {PLANNING: 1, TC: 2}
"""The highest level that counts as failing, where it is not 0."""
MIN_CASES = 5
"""With fewer passes or fails in the validation part, log-odds are only corrected for the balance of training."""

Levels = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Examples:
    """Evidence (N, F) in the order of `names`, and the manifest row of each clip with its labels."""

    names: tuple[str, ...]
    evidence: FloatArray
    rows: Sequence[ManifestRow]

    def __post_init__(self) -> None:
        if self.evidence.shape != (len(self.rows), len(self.names)):
            raise ValueError(f"evidence {self.evidence.shape} is not {len(self.rows)} clips of {len(self.names)}")

    @property
    def clean(self) -> BoolArray:
        """bool (N,), True where no label fails."""
        return np.array([row.labels.overall for row in self.rows], bool)


def sharpness_limit(examples: Examples) -> float:
    """The lowest sharpness of a frame in clips in which nothing fails. A further such clip lies below that of n with a
    probability of 1 / (n + 1). Raises ValueError: there is none.
    """
    if not examples.clean.any():
        raise ValueError(f"in each of {len(examples.rows)} clips something fails; build larger sets")
    return float(examples.evidence[examples.clean, examples.names.index(SHARPNESS)].min())


def true_levels(target: str, rows: Sequence[ManifestRow]) -> Levels:
    """Labels (N,): levels, or 1 for a component that passes and for an absent pattern, else 0; UNKNOWN without one."""
    return np.array([_true_level(target, row) for row in rows], np.int64)


def _true_level(target: str, row: ManifestRow) -> int:
    if target == PLANNING:
        level = planning_level(row.labels, row.edits)
        return UNKNOWN if level is None else level
    if target == TC:
        return row.labels.tc_level
    if target.startswith(HACK):
        return int(row.labels.pattern != target.removeprefix(HACK))
    passed: Mapping[str, bool] = row.labels.passed
    return int(passed[target]) if target in passed else UNKNOWN


def fit_questions(
    target: str, train: Examples, validation: Examples, settings: TreeSettings, seed: int
) -> tuple[HeadQuestion, ...]:
    """Fit every question of a target. Raises ValueError: training clips have only one answer; names target, level."""
    levels, held_out_levels = true_levels(target, train.rows), true_levels(target, validation.rows)
    known, held_out_known = levels != UNKNOWN, held_out_levels != UNKNOWN
    questions = []
    for k in range(num_questions(target)):
        above = levels[known] > k
        if above.all() or not above.any():
            where = "above" if above.all() else "at most"
            raise ValueError(f"training clips of {target} are all {where} level {k}; build larger sets")
        weights = np.where(above, 0.5 / above.mean(), 0.5 / (1 - above.mean()))
        rng = numpy_stream(seed, f"judge_trees/{target}", k)
        trees = fit_trees(train.evidence[known], above, weights, settings, rng)
        odds = trees.log_odds(validation.evidence[held_out_known]).astype(np.float64)
        line = _line(odds, held_out_levels[held_out_known] > k, float(above.mean()))
        if target.startswith(HACK):
            line = _flagging_line(line[0], odds, held_out_levels[held_out_known] > k)
        questions.append(HeadQuestion(trees, *line))
    return tuple(questions)


def _flagging_line(slope: float, odds: Floats, absent: BoolArray) -> tuple[float, float]:
    """(slope, offset) that give the threshold with the largest recall - false flags a pattern probability of FLAG.

    The agent confirms a pattern from this probability on. At most MAX_FALSE_FLAGS of the clips without the pattern are
    flagged; the threshold is midway between two clips.
    """
    ordered = np.unique(odds)
    thresholds = np.concatenate([[ordered[0] - 1], (ordered[1:] + ordered[:-1]) / 2])
    recall = np.array([(odds[~absent] <= t).mean() if not absent.all() else 0.0 for t in thresholds])
    false = np.array([(odds[absent] <= t).mean() if absent.any() else 0.0 for t in thresholds])
    worth = np.where(false <= MAX_FALSE_FLAGS, recall - false, -1.0)
    best = np.flatnonzero(worth >= worth.max() - 1e-12)
    threshold = float(thresholds[best[len(best) // 2]])
    return slope, float(np.log((1 - FLAG) / FLAG)) - slope * threshold


def _line(odds: Floats, above: BoolArray, share: float) -> tuple[float, float]:
    """(slope, offset) of the sigmoid of maximum likelihood, by Newton steps on Platt's smoothed targets.

    share: of passing training labels; with fewer than MIN_CASES validation cases only the balance of training is
    corrected by it.
    """
    passes, fails = int(above.sum()), int((~above).sum())
    if min(passes, fails) < MIN_CASES:
        return 1.0, float(np.log(share / (1 - share)))
    aim = np.where(above, (passes + 1) / (passes + 2), 1 / (fails + 2))
    design = np.stack([odds, np.ones_like(odds)], 1)
    line = np.array([1.0, 0.0])
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(design @ line, -30, 30)))
        pull = design.T @ (aim - p) - 0.1 * (line - [1.0, 0.0])  # a weak pull to the odds as they are
        curvature = (design * (p * (1 - p))[:, None]).T @ design + 0.1 * np.eye(2)
        line = line + np.clip(np.linalg.solve(curvature, pull), -1, 1)
    return float(np.clip(line[0], MIN_SLOPE, MAX_SLOPE)), float(line[1])


def fit_familiarity(train: Examples, validation: Examples) -> Familiarity:
    """Fit the distribution of the evidence, faults included, and the distance that covers COVERAGE of validation."""
    low, centre, high = np.quantile(train.evidence.astype(np.float64), (0.25, 0.5, 0.75), axis=0)
    spread = train.evidence.std(0, dtype=np.float64)
    scale = np.maximum(np.maximum((high - low) / 1.35, 0.5 * spread), 1e-3)
    z = np.clip((train.evidence - centre) / scale, -CLIP_AT, CLIP_AT)
    covariance = (1 - SHRINKAGE) * (z.T @ z) / len(z) + SHRINKAGE * np.eye(z.shape[1])
    unlimited = Familiarity(
        centre.astype(np.float32), scale.astype(np.float32), np.linalg.inv(covariance).astype(np.float32), 0.0
    )
    limit = float(np.quantile(unlimited.distance(validation.evidence), COVERAGE))
    return Familiarity(unlimited.centre, unlimited.scale, unlimited.precision, limit)


def fit_all(
    train: Examples, validation: Examples, settings: TreeSettings, seed: int, *, progress: bool = True
) -> dict[str, tuple[HeadQuestion, ...]]:
    """Fit the questions of every target."""
    targets = tqdm(TARGETS, desc="heads", disable=not progress)
    return {target: fit_questions(target, train, validation, settings, seed) for target in targets}


def conformal_limits(
    questions: Mapping[str, tuple[HeadQuestion, ...]], target: str, validation: Examples
) -> dict[str, tuple[float, float]]:
    """Split-conformal limits of p_fail per coverage, class by class (Vovk 2012, label-conditional).

    (low, high): a further clip that fails the target has p_fail >= low, and one that passes has p_fail <= high, each
    with at least this probability, if it is exchangeable with the validation clips of its class. So a judge that says
    "passes" below 0.5 and below low only, and "fails" from 0.5 on and above high only, calls at most 1 - coverage of
    either class the other one. 0 and 1 where there are too few clips to say.
    """
    p_fail, levels = _p_fail(questions, target, validation), true_levels(target, validation.rows)
    last = LAST_FAIL.get(target, 0)
    lowest, highest = np.sort(p_fail[(levels != UNKNOWN) & (levels <= last)]), np.sort(p_fail[levels > last])[::-1]
    limits = {}
    for coverage in CONFORMAL:
        ranks = [int((1 - coverage) * (len(scores) + 1) + 1e-9) for scores in (lowest, highest)]
        low = float(lowest[ranks[0] - 1]) if ranks[0] else 0.0
        limits[f"{coverage:g}"] = (low, float(highest[ranks[1] - 1]) if ranks[1] else 1.0)
    return limits


def conformal_errors(
    questions: Mapping[str, tuple[HeadQuestion, ...]], limits: Mapping[str, tuple[float, float]], examples: Examples
) -> dict[str, Any]:
    """Measure what abstaining between conformal limits costs and saves.

    answered: share of the clips on which every target is answered. targets: by target, silent (share without answer),
    fail_as_pass (share of failing clips that are called passing) and pass_as_fail (the reverse); the last two as
    (without abstaining, with abstaining).
    """
    answered, targets = np.ones(len(examples.rows), bool), {}
    for target, (low, high) in limits.items():
        p_fail, levels = _p_fail(questions, target, examples), true_levels(target, examples.rows)
        silent = np.where(p_fail < 0.5, p_fail >= low, p_fail <= high)
        passes = levels > LAST_FAIL.get(target, 0)
        fails = (levels != UNKNOWN) & ~passes
        answered &= ~silent
        targets[target] = {
            "silent": float(silent.mean()),
            "fail_as_pass": [float(wrong[fails].mean()) for wrong in (p_fail < 0.5, (p_fail < 0.5) & ~silent)],
            "pass_as_fail": [float(wrong[passes].mean()) for wrong in (p_fail >= 0.5, (p_fail >= 0.5) & ~silent)],
        }
    return {"answered": float(answered.mean()), "targets": targets}


def _p_fail(questions: Mapping[str, tuple[HeadQuestion, ...]], target: str, examples: Examples) -> Floats:
    above = above_levels(questions, target, examples.evidence)
    return np.array([p_fail_of(levels_of(target, column)) for column in above.T])


def measure_target(
    questions: Mapping[str, tuple[HeadQuestion, ...]], target: str, examples: Examples
) -> dict[str, Any]:
    """Measure how well a target's questions agree with the labels.

    Keys: n, fails (clips that fail), accuracy, balanced_accuracy, auroc, ece. Task completion passes from level 3
    ("nearly") on. Targets of several levels also have level_accuracy: share of clips whose likeliest level is the true
    one. Hacking patterns also have flagged and false_flags (shares of the clips with and without the pattern) and
    recall_at_5, the recall at 5 % false flags.
    """
    levels = true_levels(target, examples.rows)
    known = levels != UNKNOWN
    above = np.minimum.accumulate(above_levels(questions, target, examples.evidence[known]), 0)
    k = LAST_FAIL.get(target, 0)
    truth, p = levels[known] > k, above[k]
    metrics = {
        "n": int(known.sum()), "fails": int((~truth).sum()), "accuracy": float(((p >= 0.5) == truth).mean()),
        "balanced_accuracy": balanced_accuracy(truth, p >= 0.5), "auroc": auroc(truth, p),
        "ece": expected_calibration_error(truth, p),
    }
    if len(above) > 1:
        full = np.concatenate([np.ones((1, len(p))), above, np.zeros((1, len(p)))])
        metrics["level_accuracy"] = float(((full[:-1] - full[1:]).argmax(0) == levels[known]).mean())
    if target.startswith(HACK):
        flagged = 1 - p >= FLAG
        metrics |= {
            "flagged": wilson_of_share(flagged[~truth])[0], "false_flags": wilson_of_share(flagged[truth])[0],
            "recall_at_5": recall_at(~truth, 1 - p, 0.05),
        }
    return {name: round(value, 4) if isinstance(value, float) else value for name, value in metrics.items()}
