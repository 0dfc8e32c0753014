"""A page that shows what a log holds and takes a person's labels: one HTML file beside the pictures of the log.

It needs no network and no server. Everything that a judge, a task or a file name says is put into the page as text,
never as markup, and the page's own policy lets nothing run but its own script.
"""

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

from wm_nodes.core.files import write_atomic
from wm_nodes.judge.agent.judge import Read
from wm_nodes.judge.agent.levels import settle
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.labels import FORMAT, HACK, find_evaluation
from wm_nodes.judge.audit.media import FOLDER
from wm_nodes.judge.audit.reading import Record, RecordedEvaluation
from wm_nodes.judge.audit.sampling import Sample, SampledClip
from wm_nodes.judge.decisions import OVERALL, decisions_of
from wm_nodes.reports.summary import plain

FILE_NAME = "view.html"


def write_view(
    path: Path, record: Record, evaluations: Sequence[RecordedEvaluation], sample: Sample | None = None
) -> Path:
    """Write the page for some evaluations of a log and return its path.

    Raises:
        AuditError: an evaluation has no verdict, or the sample is of another log.
    """
    path = Path(path)
    chosen = {clip.evaluation: clip for clip in sample.chosen} if sample else {}
    clips = [_describe_clip(record, evaluation, chosen.get(evaluation.number)) for evaluation in evaluations]
    names = [[clip["evaluation"], clip["audit_id"]] for clip in clips]
    data = {
        "format": FORMAT, "head": record.head,
        "page": hashlib.sha256(json.dumps(names).encode()).hexdigest()[:16],
        "media": quote(os.path.relpath(record.folder / FOLDER, path.parent)),
        "rubrics": {version: _describe_rubric(rubric) for version, rubric in record.rubrics.items()}, "clips": clips,
    }
    write_atomic(path, page(f"audit of {record.folder.resolve().name}", data).encode())
    return path


def page(title: str, data: Mapping[str, Any]) -> str:
    """The page. data: what the script reads; numbers that are not finite are null there."""
    folder = resources.files("wm_nodes.judge.audit.viewer")
    style, script = ((folder / name).read_text(encoding="utf-8") for name in ("viewer.css", "viewer.js"))
    policy = (
        f"default-src 'none'; img-src 'self' file:; style-src {_source_expression(style)}; "
        f"script-src {_source_expression(script)}; base-uri 'none'; form-action 'none'"
    )
    text = json.dumps(plain(data), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" '
        f'content="{escape(policy)}"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body><noscript>This page needs JavaScript; "
        f'the log itself is plain text.</noscript><script type="application/json" id="data">{text}</script>'
        f"<script>{script}</script></body></html>\n"
    )


def _source_expression(text: str) -> str:
    """The source expression of a content security policy that lets just this text in."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _describe_rubric(rubric: Rubric) -> dict[str, Any]:
    """What each row means, in the order of the page."""
    entries: list[tuple[str, str, str, Sequence[str]]] = [
        (PLANNING, "PLAN", rubric.planning.question, rubric.planning.levels),
        *((n, str(s), e.question, e.levels) for s in rubric.gated for n, e in rubric.stages[s].components.items()),
        *((HACK + name, "HACK", pattern.defect, pattern.levels) for name, pattern in rubric.hack.patterns.items()),
        (OVERALL, "ALL", "Would you take this clip for a success?", ()),
    ]
    rows = [{"name": name, "stage": stage, "question": q, "levels": list(levels)} for name, stage, q, levels in entries]
    return {"rows": rows, "thresholds": {str(stage): rubric.stages[stage].threshold for stage in rubric.gated}}


def _describe_clip(record: Record, evaluation: RecordedEvaluation, chosen: SampledClip | None) -> dict[str, Any]:
    verdict = evaluation.verdict
    if chosen is not None:
        find_evaluation(chosen.evaluation, chosen.audit_id, record.evaluations, "sample")
    body, task = record.clips[evaluation.sha256], evaluation.task
    frames = body["frames"] if isinstance(body["frames"], list) else []
    return {
        "evaluation": evaluation.number, "clip_id": evaluation.clip_id, "sha256": evaluation.sha256,
        "audit_id": verdict.audit_id, "round": evaluation.round_number, "source": body["source"],
        "fps": float(body["fps"]), "frames": [_url(record, name) for name in frames],
        "reference": _picture(record, task["reference_frame"]), "goal": _picture(record, task["goal_image"]),
        "instruction": task["instruction"], "task": task["task_id"], "robot": task["robot"],
        "stratum": chosen.stratum if chosen else "",
        "second": bool(chosen and chosen.second), "rubric": evaluation.agent.rubric_version,
        "judge": {"id": verdict.provenance.judge_id, "model": verdict.provenance.model},
        "status": str(verdict.status), "reason": verdict.reason, "reward": verdict.reward,
        "weights": {str(stage): w for stage, w in verdict.plan.weights.items()} if verdict.plan else {},
        "stages": [
            {"stage": str(s.stage), "status": str(s.status), "s": s.s, "passed": s.passed, "veto": s.vetoed_by}
            for s in verdict.stages
        ],
        "rows": _describe_rows(evaluation, verdict, record.rubric(evaluation)),
        "reflections": [asdict(second) for second in verdict.reflections],
        "evidence": evaluation.evidence,
        "cost": vars(verdict.cost),
        "reads": verdict.num_reads,
    }


def _describe_rows(evaluation: RecordedEvaluation, verdict: Verdict, rubric: Rubric) -> dict[str, Any]:
    """What the judge says of each row: value (True, False, a level, None), why, and the votes behind it."""
    values = {name: decision.value for name, decision in decisions_of(verdict).items()}
    asked = [(ask.stage, read) for ask in evaluation.asks for read in ask.reads]
    rows: dict[str, Any] = {}
    planning = [read for stage, read in asked if stage == "PLAN"]
    plan = verdict.plan
    rows[PLANNING] = {
        "value": values.get(PLANNING), "why": plan.reason if plan else "",
        "decided_by": f"focus: {', '.join(plan.focus) or 'none'}" if plan else "", "frames": [],
        "votes": [_describe_vote(read) for read in planning],
    }
    for score in (score for stage in verdict.stages for score in stage.components):
        rows[score.component] = {
            "value": values.get(score.component), "s": score.s, "p_fail": score.p_fail,
            "margin": score.margin, "why": score.evidence_text, "decided_by": score.decided_by, "reason": score.reason,
            "frames": score.frames_cited, "votes": [_describe_vote(read) for read in score.votes],
        }
    for flag in verdict.hack_flags:
        reads = [read for stage, read in asked if stage == "HACK" and read.component == flag.pattern]
        looks = [settle([read], rubric.voting.min_label_mass) for read in reads]
        rows[HACK + flag.pattern] = {
            "value": not flag.confirmed, "p_fail": flag.p_present, "why": flag.evidence_text,
            "decided_by": "confirmed by a second read" if flag.confirmed else "not confirmed",
            "reason": "; ".join(look.reason for look in looks if look.reason), "frames": [],
            "votes": [_describe_vote(read) for read in reads],
        }
    rows[OVERALL] = {"value": values.get(OVERALL), "why": "", "decided_by": "all gates", "frames": [], "votes": []}
    return rows


def _describe_vote(read: Read) -> dict[str, Any]:
    return {
        "index": read.vote.index, "kind": read.source, "polarity": read.vote.polarity, "status": str(read.status),
        "levels": read.levels, "mass": read.label_mass, "why": read.evidence_text,
        "reason": read.reason, "frames": read.frames_cited,
    }


def _url(record: Record, name: str) -> str:
    """Below the media folder; the name is checked, because it comes from a file."""
    return str(record.store.path(name).relative_to(record.folder / FOLDER))


def _picture(record: Record, name: str | None) -> str:
    return _url(record, name) if name and name.endswith(".png") else ""
