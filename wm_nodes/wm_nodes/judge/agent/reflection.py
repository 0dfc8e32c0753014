"""When the agent reflects on a verdict, and which of the proposed changes count (RA-13, RA-14, RA-17). Pure functions.

The second read sees new frames (profile D) and must cite frames; its change counts only if a fresh label read on those
frames agrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wm_nodes.judge.agent.judge import ComponentScore, Read
from wm_nodes.judge.agent.levels import score
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import NUM_PLAN_LEVELS, Component, Evidence, Status
from wm_nodes.judge.agent.verdict import PlanResult, StageScore

MIN_CHANGE = 0.125
"""Half a level, in units of s: less is no change."""


@dataclass(frozen=True)
class Trigger:
    """Why, in words, and which components are suspected; none: those with the smallest margins."""

    reason: str
    components: tuple[Component, ...] = ()


def triggers(
    plan: PlanResult, stages: Sequence[StageScore], rubric: Rubric, evidence: Evidence, *, drawn: bool
) -> list[Trigger]:
    """Every reason to look again. stages: VQ, IF, TC, PC; SKIPPED and ABSTAIN ones say nothing. drawn: at random."""
    rules = rubric.reflection
    known = [stage for stage in stages if stage.status is Status.OK]
    scores = {score.component: score for stage in known for score in stage.components}
    result: list[Trigger] = []
    for rule in rules.conflicts:
        failed = tuple(name for name in rule.needs if name in scores and not scores[name].passed)
        if failed and rule.done in scores and scores[rule.done].passed:
            result.append(Trigger(f"{rule.done} passed while {', '.join(failed)} failed", (rule.done, *failed)))
    if known:
        mean = float(np.mean([stage.s for stage in known]))
        if abs(plan.level - (NUM_PLAN_LEVELS - 1) * mean) >= rules.level_gap:
            result.append(Trigger(f"planning level {plan.level} against a mean stage score of {mean:.2f}"))
    quality, physics = stages[0], stages[-1]
    both = quality.status is physics.status is Status.OK
    confident = all(score.margin >= rubric.voting.clear_margin for score in physics.components)
    if both and not quality.passed and physics.passed and confident:
        result.append(Trigger("VQ failed but PC is confident", tuple(s.component for s in quality.components)))
    for stage in known:
        lowest = min(stage.components, key=lambda score: score.s)
        if lowest.margin < rules.margin:
            reason = f"{lowest.component} decided {stage.stage} with margin {lowest.margin:.2f}"
            result.append(Trigger(reason, (lowest.component,)))
    for name in conflicting(evidence):
        if name in scores and scores[name].passed:
            result.append(Trigger(f"{name} passed against evidence {evidence[name]:.3g}", (name,)))
    if drawn:
        result.append(Trigger("drawn at random"))
    return result


def conflicting(evidence: Evidence) -> list[Component]:
    """Components whose evidence is beyond its limit, NaN included."""
    return [name for name, strangeness in evidence.items() if not strangeness <= 1]


def suspects(reasons: Sequence[Trigger], stages: Sequence[StageScore], limit: int) -> tuple[Component, ...]:
    """At most `limit` components to look at again: those named, then those with the smallest margins."""
    scores = [score for stage in stages if stage.status is Status.OK for score in stage.components]
    named = [name for trigger in reasons for name in trigger.components]
    doubtful = sorted(scores, key=lambda score: score.margin)
    return tuple(dict.fromkeys([*named, *(score.component for score in doubtful)]))[:limit]


def proposes_change(before: ComponentScore, second: Read, num_frames: int) -> bool:
    """Whether the second read changes the score by half a level or more, and cites frames that exist."""
    cites = bool(second.frames_cited) and all(0 <= index < num_frames for index in second.frames_cited)
    return cites and abs(score([second], "").s - before.s) >= MIN_CHANGE


def is_confirmed(before: ComponentScore, second: Read, fresh: Read) -> bool:
    """Whether the fresh read passes or fails as the second one does, and is nearer to it than to the score before."""
    proposed, checked = score([second], ""), score([fresh], "")
    return checked.passed == proposed.passed and abs(checked.s - proposed.s) < abs(checked.s - before.s)
