"""Decisions of a verdict, by the row names of the paper's Table 2; labels of people and of recipes use the same names.

A decision is True (passes), False, or a planning level; undecided rows are missing. A stage passes where its gate
passes, except TC, which passes from level 3 on, because its gate asks for visible progress only. Overall passes where
every gate passed and the task is completed (RA-24): our choice, the paper does not define it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from wm_nodes.core.statistics import balanced_accuracy, expected_calibration_error, kappa, wilson_of_share
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING, Stage, Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.dataset.edits.clips import TC

OVERALL = "overall"
STAGES = (Stage.VQ, Stage.IF, Stage.PC)
PAPER: Mapping[str, float] = {
    PLANNING: 98.0, "VQ": 96.0, "clarity": 100.0, "brightness": 100.0, "color": 96.0, "temporal": 96.0, "IF": 90.0,
    "background": 95.0, "objective": 85.0, "robot": 88.0, "viewpoint": 100.0, "PC": 82.0, "interaction": 85.0,
    "deformation": 82.0, "geometry": 86.0, TC: 87.0, OVERALL: 91.0,
}
"""Table 2 of the paper, accuracy in percent on 100 clips."""
FAIR_LEVEL = 2
"""A planning label below this counts as a fail in the prevalence."""


@dataclass(frozen=True)
class Decision:
    """One decision. p_pass: probability of a pass, or of the planning level, in [0, 1]."""

    value: bool | int
    p_pass: float


class Match(NamedTuple):
    """Agreement of decisions with labels; NaN where all labels are equal."""

    accuracy: float
    """Share of equal decisions."""
    low: float
    high: float
    """95 % Wilson interval of the accuracy."""
    prevalence: float
    """Share of failing labels; of planning, of levels below 2."""
    balanced: float
    """Balanced accuracy; of planning, the mean recall of its levels."""
    kappa: float
    calibration: float
    """Expected calibration error of p_pass; of planning, of the chosen level."""


def match(
    name: str, labels: Sequence[bool | int], decisions: Sequence[Decision], weights: ArrayLike | None = None
) -> Match:
    """Measure the agreement of the row `name`. weights: of each decision; kappa and level recall are unweighted."""
    values, p_pass = [decision.value for decision in decisions], [decision.p_pass for decision in decisions]
    right, planning = [label == value for label, value in zip(labels, values, strict=True)], name == PLANNING
    failing = [label < FAIR_LEVEL if planning else not label for label in labels]
    return Match(
        *wilson_of_share(right, weights), wilson_of_share(failing, weights)[0],
        _level_recall(labels, right) if planning else balanced_accuracy(labels, values, weights),
        kappa(labels, values), expected_calibration_error(right if planning else labels, p_pass, weights),
    )


def _level_recall(labels: Sequence[int], right: Sequence[bool]) -> float:
    recalls = [np.mean([ok for label, ok in zip(labels, right) if label == level]) for level in set(labels)]
    return float(np.mean(recalls)) if len(recalls) > 1 else float("nan")


def row_names(rubric: Rubric) -> list[str]:
    """Planning, each stage with its components below it, overall: the order of the table."""
    names = [PLANNING]
    for stage in (stage for stage in STAGES if stage in rubric.stages):
        names += [str(stage), *rubric.stages[stage].components]
    return [*names, *rubric.stages[Stage.TC].components, OVERALL]


def decisions_of(verdict: Verdict) -> dict[str, Decision]:
    """The decisions of a verdict by row.

    p_pass of a stage is the least of its components; of overall, the least of its rows.
    """
    decisions: dict[str, Decision] = {}
    scores = {score.component: score for stage in verdict.stages for score in stage.components}
    for name, score in scores.items():
        if score.status is Status.OK:
            decisions[name] = Decision(score.passed, 1 - score.p_fail)
    for stage in verdict.stages:
        if stage.status is Status.OK and stage.stage is not Stage.TC:
            least = min(1 - score.p_fail for score in stage.components)
            decisions[str(stage.stage)] = Decision(stage.passed, 0.0 if stage.vetoed_by.startswith("hack ") else least)
    if verdict.plan is not None:
        decisions[PLANNING] = Decision(verdict.level, verdict.plan.p_level[verdict.level])
    elif verdict.level == 0:
        decisions[PLANNING] = Decision(0, 1.0)
    accepted = accepts(verdict)
    if accepted is not None:
        parts = [decision.p_pass for name, decision in decisions.items() if name in (TC, *map(str, STAGES))]
        decisions[OVERALL] = Decision(accepted, min(parts, default=0.0))
    return decisions


def accepts(verdict: Verdict) -> bool | None:
    """Whether a trainer would take the clip for a success; None where the verdict has no number.

    A failed gate means False, even if later stages abstained.
    """
    if verdict.status is Status.ERROR:
        return None
    read = [stage for stage in verdict.stages if stage.status is Status.OK]
    completion = [score for stage in read for score in stage.components if score.component == TC]
    if any(not stage.passed for stage in read) or any(not score.passed for score in completion):
        return False
    return len(read) == len(verdict.stages) if verdict.status is Status.OK else None
