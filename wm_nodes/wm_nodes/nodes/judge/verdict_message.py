"""The reward agent's verdict as a message. Shapes: C components, H hacking patterns."""

import math
from array import array
from collections.abc import Iterable

from wm_msgs.msg import ClipVerdict
from wm_nodes.judge.agent.scoring import skipped_stage
from wm_nodes.judge.agent.types import GATED, Status
from wm_nodes.judge.agent.verdict import Reflection, Verdict

STATUS = {
    Status.OK: ClipVerdict.OK, Status.SKIPPED: ClipVerdict.SKIPPED, Status.ABSTAIN: ClipVerdict.ABSTAIN,
    Status.ERROR: ClipVerdict.ERROR,
}


def verdict_msg(verdict: Verdict) -> ClipVerdict:
    """Everything of a verdict but which buffer or episode it is of, the header, session and seq."""
    cost, by, plan = verdict.cost, verdict.provenance, verdict.plan
    known = {stage.stage: stage for stage in verdict.stages}
    stages = [known.get(stage, skipped_stage(stage)) for stage in GATED]  # mode topreward has one of them
    parts = [(stage, component) for stage in stages for component in stage.components]
    return ClipVerdict(
        clip_id=verdict.clip_id, status=STATUS[verdict.status], reward=verdict.reward, reason=verdict.reason,
        level=verdict.level, level_p=_doubles(plan.p_level if plan else ()),
        level_weights=_doubles([plan.weights[stage] for stage in GATED] if plan else ()),
        stages=[str(stage.stage) for stage in stages],
        stage_scores=_doubles(stage.s for stage in stages),
        stage_status=_bytes(STATUS[stage.status] for stage in stages),
        stage_passed=_bytes(stage.passed for stage in stages),
        stage_vetoed_by=[stage.vetoed_by for stage in stages], components=[part.component for _, part in parts],
        component_stages=[str(stage.stage) for stage, _ in parts],
        component_scores=_doubles(part.s for _, part in parts),
        component_p_fail=_doubles(part.p_fail for _, part in parts),
        component_status=_bytes(STATUS[part.status] for _, part in parts),
        component_decided=[part.decided_by for _, part in parts],
        component_reasons=[part.reason or part.evidence_text for _, part in parts],
        hack_patterns=[flag.pattern for flag in verdict.hack_flags],
        hack_p=_doubles(flag.p_present for flag in verdict.hack_flags),
        hack_confirmed=_bytes(flag.confirmed for flag in verdict.hack_flags),
        reflections=[line for reflection in verdict.reflections for line in _lines(reflection)],
        num_reads=verdict.num_reads, calls=cost.calls, prompt_tokens=cost.prompt_tokens,
        cached_tokens=cost.cached_tokens, completion_tokens=cost.completion_tokens, images=cost.images,
        retries=cost.retries, usd=math.nan, wall_s=cost.wall_s, judge_id=by.judge_id,
        transport=by.transport, model=by.model, server_version=by.server_version, rubric_version=by.rubric_version,
        prompt_sha=by.prompt_sha, media_sha=by.media_sha, judge_seed=by.seed, audit_id=verdict.audit_id,
    )


def _lines(reflection: Reflection) -> list[str]:
    why = "; ".join(reflection.triggers)
    changes = [
        f"{change.component} {change.before:.2f} -> {change.after:.2f} "
        f"({'accepted' if change.accepted else 'not confirmed'}): {change.reason}"
        for change in reflection.changed
    ]
    return [f"{change} [{why}]" for change in changes] or [f"nothing changed [{why}]"]


def _doubles(values: Iterable[float]) -> "array[float]":
    return array("d", values)


def _bytes(values: Iterable[int]) -> "array[int]":
    return array("B", map(int, values))
