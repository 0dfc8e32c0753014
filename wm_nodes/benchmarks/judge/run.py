"""Judge the clips of a set, resumably: one line per clip in a file that belongs to one judge, rubric, mode and seed."""

import asyncio
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.judge.call_counter import CallCounts, CountingJudge
from benchmarks.judge.labels import pattern_scores
from benchmarks.judge.line_file import LineFile
from wm_nodes.judge.agent.judge import Capabilities, Cost, Judge
from wm_nodes.judge.agent.machine import Mode, RewardAgent
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.dataset.rows import read_clip
from wm_nodes.judge.decisions import Decision, decisions_of


@dataclass(frozen=True)
class Outcome:
    """What is kept of a verdict. reward: None unless the status is OK. decisions, patterns: see labels."""

    sha256: str
    status: str
    reason: str
    reward: float | None
    decisions: dict[str, Decision]
    patterns: dict[str, dict[str, Any]]
    asked: CallCounts
    cost: Cost
    wall_s: float


@dataclass(frozen=True)
class JudgeTrial:
    """One way of judging. name: of the file and of its rows in tables."""

    name: str
    rubric: Rubric
    mode: Mode = "benchmark"
    seed: int = 0
    max_reads: int = 120

    def key(self, able: Capabilities) -> str:
        """Names judge, rubric and settings: outcomes of equal keys may be mixed, others never."""
        who = (able.judge_id, able.transport, able.model, able.server_version)
        text = json.dumps([*who, self.rubric.version, self.mode, self.seed, self.max_reads])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


async def judge_rows(
    judge: Judge, trial: JudgeTrial, folder: Path, rows: Sequence[ManifestRow], file: LineFile[Outcome], *,
    at_once: int = 1, on_clip: Callable[[], object] = lambda: None,
) -> list[Outcome]:
    """Judge what `file` does not hold yet; returns an outcome per row, in their order. An ERROR is tried again next
    time: it is no answer. at_once: clips under way together, for a judge behind a server. on_clip: called after each
    clip, known or new.

    Raises:
        ManifestError: a clip cannot be read.
    """
    gate = asyncio.Semaphore(at_once)
    fresh: dict[str, Outcome] = {}

    async def judge_row(row: ManifestRow) -> None:
        async with gate:
            known = file.rows.get(row.sha256)
            if known is None or known.status == "ERROR":
                clip, task = read_clip(folder, row)
                metered = CountingJudge(judge)
                agent = RewardAgent(
                    metered, trial.rubric, mode=trial.mode, seed=trial.seed, max_reads=trial.max_reads, call_plan="pack"
                )
                verdict = await agent.evaluate(clip, task)
                known = Outcome(
                    verdict.provenance.media_sha, str(verdict.status), verdict.reason,
                    verdict.reward if verdict.valid else None, decisions_of(verdict), pattern_scores(verdict),
                    metered.asked, replace(verdict.cost, wall_s=0.0), verdict.cost.wall_s,
                )
                file.add(known)
            fresh[row.sha256] = known
            on_clip()

    async with asyncio.TaskGroup() as group:
        for row in rows:
            group.create_task(judge_row(row))
    return [fresh[row.sha256] for row in rows]
