"""Decisions of a verdict, by the row names of the paper's Table 2; labels of people and of recipes use the same names.

A decision is True (passes), False, or a planning level; undecided rows are missing. A stage passes where its gate
passes, except TC, which passes from level 3 on, because its gate asks for visible progress only. Overall passes where
every gate passed and the task is completed (RA-24): our choice, the paper does not define it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING, TASK_COMPLETION, Stage, Status
from wm_nodes.judge.agent.verdict import Verdict

OVERALL = "overall"
STAGES = (Stage.VQ, Stage.IF, Stage.PC)


@dataclass(frozen=True)
class Decision:
    """One decision. p_pass: probability of a pass, or of the planning level, in [0, 1]."""

    value: bool | int
    p_pass: float


def row_names(rubric: Rubric) -> list[str]:
    """Planning, each stage with its components below it, overall: the order of the table."""
    names = [PLANNING]
    for stage in (stage for stage in STAGES if stage in rubric.stages):
        names += [str(stage), *rubric.stages[stage].components]
    completion = rubric.stages[Stage.TC].components if Stage.TC in rubric.stages else ()
    return [*names, *completion, OVERALL]


def stage_labels(components: Mapping[str, bool | int | None], rubric: Rubric) -> dict[str, bool | None]:
    """Whether each stage passes by what is known of its components; stages of which nothing is known are left out.

    A stage fails with any of its components, and is unknown (None) only where none is known to fail.
    """
    labels: dict[str, bool | None] = {}
    for stage in (stage for stage in STAGES if stage in rubric.stages):
        names = rubric.stages[stage].components
        if any(name in components for name in names):
            parts = [components.get(name) for name in names]
            labels[str(stage)] = False if False in parts else None if None in parts else True
    return labels


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
        rows = {TASK_COMPLETION, *map(str, STAGES)}
        parts = [decision.p_pass for name, decision in decisions.items() if name in rows]
        decisions[OVERALL] = Decision(accepted, min(parts, default=0.0))
    return decisions


def accepts(verdict: Verdict) -> bool | None:
    """Whether a trainer would take the clip for a success; None where the verdict has no number.

    A failed gate means False, even if later stages abstained. Where none failed, every stage of the rubric was read, as
    scoring.reward demands of a number; PRECHECK alone gives one without any stage.
    """
    if verdict.status is Status.ERROR:
        return None
    read = [stage for stage in verdict.stages if stage.status is Status.OK]
    completion = [score for stage in read for score in stage.components if score.component == TASK_COMPLETION]
    if any(not stage.passed for stage in read) or any(not score.passed for score in completion):
        return False
    return bool(read) if verdict.status is Status.OK else None
