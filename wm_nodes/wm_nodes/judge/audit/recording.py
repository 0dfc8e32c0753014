"""A reward agent that writes every question, answer and verdict into an audit log."""

import asyncio
import math
from collections.abc import Mapping
from contextvars import ContextVar
from typing import Any

from wm_nodes.judge.agent.judge import ForwardingJudge, Judge, JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import ClipRef, Evidence, TaskSpec
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.entries import clip_body, plain, rubric_body, task_body
from wm_nodes.judge.audit.log import AuditLog
from wm_nodes.judge.audit.media import MediaStore

_EVALUATION: ContextVar[int] = ContextVar("evaluation")
"""Line of the evaluation that the running task belongs to; reads of several clips are written between each other."""


class AuditedAgent(RewardAgent):
    """A RewardAgent that writes everything into a log, with the same verdicts.

    Args:
        settings: of RewardAgent. round_number: of the paper's loop, kept with every verdict; may be changed.
    """

    def __init__(self, judge: Judge, rubric: Rubric, log: AuditLog, *, round_number: int = 0, **settings: Any) -> None:
        super().__init__(RecordingJudge(judge, log), rubric, **settings)
        self.round_number = round_number
        self._log, self._store = log, MediaStore(log.folder)
        self._written: set[str] = set()
        log.append("rubric", rubric_body(rubric))
        limits = {name: getattr(self, name) for name in ("mode", "seed", "max_reads", "budget_s", "call_plan")}
        self._line = log.append(
            "agent",
            {"capabilities": plain(judge.capabilities), "rubric_version": rubric.version, "settings": plain(limits)},
        )

    async def evaluate(
        self, clip: ClipRef, task: TaskSpec, evidence: Evidence | None = None, *, within_s: float = math.inf
    ) -> Verdict:
        """Judge one clip; the verdict is on the disk when this returns. Raises OSError: it cannot be written down."""
        if clip.sha256 not in self._written:
            self._log.append("clip", clip_body(clip, self._store))
            self._written.add(clip.sha256)
        evaluation = self._log.append("evaluation", {
            "clip_id": clip.clip_id, "sha256": clip.sha256, "agent": self._line, "round": self.round_number,
            "task": task_body(task, self._store), "evidence": plain(evidence or {}),
        })
        token = _EVALUATION.set(evaluation)
        try:
            verdict = await super().evaluate(clip, task, evidence, within_s=within_s)
        finally:
            _EVALUATION.reset(token)
        self._log.append("verdict", {"evaluation": evaluation, "verdict": plain(verdict)}, sync=True)
        return verdict


class RecordingJudge(ForwardingJudge):
    """Hands questions on to a judge and writes them down with the answers, or with what went wrong."""

    def __init__(self, judge: Judge, log: AuditLog) -> None:
        super().__init__(judge)
        self._log = log

    async def read(self, request: ReadRequest) -> list[Read]:
        evaluation = _EVALUATION.get()
        ask = self._log.append("ask", {"evaluation": evaluation, **ask_body(request)})
        about = {"evaluation": evaluation, "ask": ask}
        try:
            reads = await super().read(request)
        except (Exception, asyncio.CancelledError) as error:
            cost = plain(error.cost) if isinstance(error, JudgeError) else None
            failure = {"error": type(error).__name__, "reason": str(error), "cost": cost}
            self._log.append("failure", {**about, **failure})
            raise
        for read in reads:
            self._log.append("read", {**about, "read": plain(read)})
        return reads


def ask_body(request: ReadRequest) -> dict[str, Any]:
    """A request without its clip, its task and what was found before: those are in the log already."""
    names = ("stage", "components", "profile", "votes", "media", "mode")
    return {name: plain(getattr(request, name)) for name in names}


def write_exchange(log: AuditLog, exchange: Mapping[str, Any]) -> None:
    """Write down what went over the wire; call it from within a judge's read, e.g. as OpenAIJudge's `on_exchange`."""
    log.append("exchange", {"evaluation": _EVALUATION.get(), **plain(exchange)})
