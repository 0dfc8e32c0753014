"""Stage scores, gates, planning weights and the reward: pure functions of scores (RA-4, RA-9 to RA-12).

R = sum_d w_d S_d prod_{e before d} 1[S_e >= theta_e] over d = VQ, IF, TC, PC. A number that is missing makes R NaN.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from wm_nodes.judge.agent.judge import ComponentScore, Read
from wm_nodes.judge.agent.rubric import PlanningRubric, Rubric
from wm_nodes.judge.agent.types import GATED, NUM_PLAN_LEVELS, Stage, Status
from wm_nodes.judge.agent.verdict import PlanResult, StageScore


def skipped_stage(stage: Stage) -> StageScore:
    return StageScore(stage, Status.SKIPPED, math.nan, False)


def stage_score(stage: Stage, scores: Sequence[ComponentScore], rubric: Rubric) -> StageScore:
    """S = 0.5 weighted_mean(s_c) + 0.5 min(s_c); passed where S >= theta and no p_fail >= veto.

    One component with an ERROR makes the stage one, else one that abstained makes it ABSTAIN.
    """
    for status in (Status.ERROR, Status.ABSTAIN):
        if any(score.status is status for score in scores):
            return StageScore(stage, status, math.nan, False, tuple(scores))
    described = rubric.stages[stage]
    weights = [described.components[score.component].weight for score in scores]
    mean = math.fsum(weight * score.s for weight, score in zip(weights, scores)) / math.fsum(weights)
    share = rubric.reward.mean_share
    s = min(1.0, share * mean + (1 - share) * min(score.s for score in scores))
    veto = next((score.component for score in scores if score.p_fail >= rubric.voting.veto), "")
    return StageScore(stage, Status.OK, s, s >= described.threshold and not veto, tuple(scores), veto)


def plan_result(read: Read, rubric: Rubric) -> PlanResult:
    """The planning level and the weights it gives. `read` is OK and has a distribution over L0 to L3."""
    known = [name for name in dict.fromkeys(read.focus) if name in rubric.component_names]
    level = max(range(NUM_PLAN_LEVELS), key=lambda index: (read.levels[index], -index))
    weights = plan_weights(read.levels, rubric.planning)
    return PlanResult(read.levels, level, weights, tuple(known[: rubric.planning.num_focus]), read.evidence_text)


def plan_weights(p_level: Sequence[float], planning: PlanningRubric) -> dict[Stage, float]:
    """w = sum_l p_l ceiling_l W[l]. Soft, so a flip between neighbouring levels cannot make the reward jump."""
    scaled = [p * ceiling for p, ceiling in zip(p_level, planning.ceiling)]
    return {
        stage: math.fsum(factor * row[column] for factor, row in zip(scaled, planning.weights))
        for column, stage in enumerate(GATED)
    }


def gate_is_open(score: StageScore, rubric: Rubric) -> bool:
    """Whether the stages after this one are read and count: it passed, or the rubric's gates are open."""
    return score.status is Status.OK and (score.passed or rubric.reward.gate == "open")


def reward(weights: Mapping[Stage, float], stages: Sequence[StageScore], rubric: Rubric) -> float:
    """R in [0, 1] of VQ, IF, TC, PC, in this order; NaN where a stage that was looked at has no number.

    Stages that the rubric does not have count for nothing.

    Raises:
        ValueError: stages in another order, or one skipped behind an open gate.
    """
    if tuple(score.stage for score in stages) != GATED:
        raise ValueError(f"stages must be VQ, IF, TC, PC, got {', '.join(score.stage for score in stages)}")
    if any(score.status in (Status.ERROR, Status.ABSTAIN) for score in stages):
        return math.nan
    total = 0.0
    for score in (score for score in stages if score.stage in rubric.stages):
        if score.status is Status.SKIPPED:
            raise ValueError(f"{score.stage} was skipped though every gate before it is open")
        total += weights[score.stage] * score.s
        if not gate_is_open(score, rubric):
            break
    return min(1.0, total)


def apply_caps(stages: Sequence[StageScore], patterns: Sequence[str], rubric: Rubric) -> tuple[StageScore, ...]:
    """Apply the caps of confirmed hacking patterns. They lower scores and close gates, and never raise anything."""
    result = {score.stage: score for score in stages}
    for name in patterns:
        cap = rubric.hack.patterns[name].cap
        target = cap.stage or rubric.stage_of(cap.component or "")
        before = result[target]
        if before.status is not Status.OK:
            continue
        if cap.stage is not None:
            result[target] = replace(before, s=0.0, passed=False, vetoed_by=f"hack {name}")
            continue
        scores = [_limit(c, cap.ceiling, name) if c.component == cap.component else c for c in before.components]
        after = stage_score(target, scores, rubric)
        closed = before.vetoed_by.startswith("hack ")
        result[target] = replace(after, s=0.0, passed=False, vetoed_by=before.vetoed_by) if closed else after
    return tuple(result.values())


def _limit(score: ComponentScore, ceiling: float, pattern: str) -> ComponentScore:
    """At most `ceiling`; a score of s fails with probability 1 - s at least, up to level 1."""
    if score.s <= ceiling:
        return score
    p_fail = max(score.p_fail, 1 - ceiling)
    return replace(score, s=ceiling, p_fail=p_fail, margin=abs(1 - 2 * p_fail), decided_by=f"cap by {pattern}")
