"""What a trainer may do with verdicts (RA-15). Shapes: N clips."""

from collections.abc import Sequence

from wm_nodes.judge.agent.verdict import Verdict

MAX_INVALID_SHARE = 0.1
"""A round with more invalid clips pauses training."""


def pause_reason(verdicts: Sequence[Verdict]) -> str:
    """Why training must pause after this round, with an example; "" where it may go on."""
    invalid = [verdict for verdict in verdicts if not verdict.valid]
    if len(invalid) <= MAX_INVALID_SHARE * len(verdicts):
        return ""
    first = invalid[0]
    return (
        f"{len(invalid)} of {len(verdicts)} verdicts are invalid, more than {MAX_INVALID_SHARE:.0%}; "
        f"e.g. {first.clip_id}: {first.status} {first.reason}"
    )


def check_one_judge(verdicts: Sequence[Verdict], group_ids: Sequence[int]) -> None:
    """Refuse a group that several judges, models or rubrics judged. Raises ValueError: names the group and the mix."""
    seen: dict[int, tuple[str, ...]] = {}
    for verdict, group in zip(verdicts, group_ids, strict=True):
        p = verdict.provenance
        identity = (p.judge_id, p.transport, p.model, p.server_version, p.rubric_version)
        if seen.setdefault(group, identity) != identity:
            raise ValueError(f"group {group} mixes judges {seen[group]} and {identity}; judge the whole group again")
