"""A service that judges many clips with the reward agent, for callers that do not use asyncio (RA-1, RA-15).

Shapes: N clips, F frames, H W 3 image, A action.
"""

import asyncio
import math
import threading
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.schema import AGENT
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import CPU
from wm_nodes.core.named_files import RUBRIC, NamedFiles
from wm_nodes.judge.agent.judge import Cost, Health
from wm_nodes.judge.agent.machine import OUT_OF_ROUND, RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.scoring import skipped_stage
from wm_nodes.judge.agent.types import GATED, ClipRef, Status, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Provenance, Verdict, content_hash
from wm_nodes.judge.audit.log import AuditLog
from wm_nodes.judge.audit.recording import AuditedAgent, write_exchange
from wm_nodes.judge.backends.factory import OpenedJudge, evidence_judge, for_task, make_judge
from wm_nodes.recording.reader import read_spec
from wm_nodes.video_model.clips import Clips

READS = "judge_reads"
"""Folder of a run with the cached answers of the judge."""
POLL_S = 0.05
"""How often a waiting caller checks whether it must stop, s."""
HEALTH_S = 10.0
"""Time between two health requests to the servers, s."""
CLOSE_S = 5.0

T = TypeVar("T")


class TrainingPaused(Exception):
    """Too many clips of a round have no reward; the text says why and what to do."""


@dataclass(frozen=True, eq=False)
class ClipJob:
    """A clip and what it should show."""

    clip: ClipRef
    """To judge."""
    task: TaskSpec
    """What it should show."""
    problem: str = ""
    """Why its pixels cannot be read; its verdict is then an ERROR."""


@dataclass
class VerdictCounts:
    """Number and cost of the verdicts since the start."""

    verdicts: int = 0
    """All."""
    by_status: dict[Status, int] = field(default_factory=dict)
    """Number of each status."""
    cost: Cost = field(default_factory=Cost)
    """Of all together."""

    def add(self, verdict: Verdict) -> None:
        self.verdicts += 1
        self.by_status[verdict.status] = self.by_status.get(verdict.status, 0) + 1
        self.cost += verdict.cost

    @property
    def invalid_rate(self) -> float:
        return 1 - self.by_status.get(Status.OK, 0) / self.verdicts if self.verdicts else 0.0

    @property
    def cached_ratio(self) -> float:
        """Share of prompt tokens that the server had in its prefix cache."""
        return self.cost.cached_tokens / self.cost.prompt_tokens if self.cost.prompt_tokens else 0.0


@dataclass
class _JudgeSlot:
    """One judge with its agent."""

    opened: OpenedJudge
    agent: RewardAgent

    @property
    def judge_id(self) -> str:
        return self.agent.judge.capabilities.judge_id


class JudgeService:
    """Runs a reward agent on an event loop in a thread of its own; at most `concurrency` clips at a time.

    Args:
        tasks: of the clips, each of which is judged by the judge of its task, see for_task; (): the settings name the
            judge of all. On clips of a task without a judge the verdict is ABSTAIN and says so.
        reads: folder that keeps the judge's answers; None: none are kept.
        audit: folder of the audit log that every question, answer and verdict goes into; None: none is written.
        model_dir: world model whose normal ranges say how strange a clip is beside a server's answers; None: none does.
        device: the setting `device` (core/device.py), where embedded judges compute.

    Raises:
        ValueError, MissingPackageError: as make_judge; not one task has a judge. ConfigError: the rubric is refused.
        AuditError: as AuditLog.
    """

    def __init__(
        self, settings: JudgeConfig, *, seed: int, tasks: Iterable[str] = (), reads: Path | None = None,
        audit: Path | None = None, model_dir: Path | None = None, device: str = CPU,
    ) -> None:
        self.settings, self._seed, self._reads, self._device = settings, seed, reads, device
        self._evidence = evidence_judge(settings, model_dir, device)
        self._log = None if audit is None else AuditLog(audit)
        self.pack, self.tally, self.health = settings.rubric, VerdictCounts(), Health(True, "not asked yet")
        self._settings_of, self._refused = _settings_by_task(settings, tasks)
        self._slots = self._make_slots(load_rubric(settings.rubric))
        self._semaphore = asyncio.Semaphore(settings.concurrency)
        self._health_asked_s = -math.inf
        self._health_request: Future[None] | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="reward agent", daemon=True)
        self._thread.start()

    @property
    def rubric(self) -> Rubric:
        return self._first.agent.rubric

    @property
    def version(self) -> str:
        """Of the words that the judges are asked in, see RewardAgent."""
        return self._first.agent.version

    @property
    def judge_id(self) -> str:
        """Identity of the judge, or of all, where tasks have different ones."""
        return "; ".join(dict.fromkeys(slot.judge_id for slot in self._slots.values()))

    def judge_of(self, task: str) -> str:
        """Identity of the judge of a task."""
        return self._slot_of(task).judge_id

    @property
    def cards(self) -> list[str]:
        """The measured abilities of each judge, as text; judges without a measurement are left out."""
        return [card for slot in _distinct(self._slots) if (card := slot.agent.judge.capabilities.card)]

    def set_rubric(self, pack: str, files: NamedFiles) -> None:
        """Judge by another rubric from now on; call it while nothing is being judged.

        Args:
            pack: a pack's name, or a YAML file among `files`, as are those that it extends.

        Raises:
            ConfigError: no such pack, or one that is refused; the rubric is then the one before.
            FileRefused, OSError: as files.read.
            ValueError: the judge cannot read all of its components, or max_reads does not cover them.
        """
        rubric = load_rubric(pack, read=lambda name: files.read(name, RUBRIC))
        old, self._slots = self._slots, self._make_slots(rubric)
        self.pack = pack
        for slot in _distinct(old):
            self._run(slot.opened.close())

    def submit(self, job: ClipJob, deadline: float | None = None) -> "Future[Verdict]":
        """Have one clip judged, concurrency permitting. deadline: on the time.monotonic clock, s."""
        return self._run(self._judge_clip(job, deadline))

    def judge(
        self, jobs: Sequence[ClipJob], *, check: Callable[[], None] = lambda: None,
        done: Callable[[int, Verdict], None] = lambda index, verdict: None, within_s: float | None = None,
        round_number: int = 0,
    ) -> list[Verdict]:
        """Judge a round of clips; the verdicts are in the order of the jobs.

        Args:
            check: called at least every POLL_S; an exception from it ends the judging and cancels open calls.
            done: called in this thread with the index and verdict of every clip.
            within_s: clips without a verdict after this time get one with status ERROR; None: no limit.
            round_number: of these clips in the audit log.
        """
        deadline = None if within_s is None else time.monotonic() + within_s
        for slot in self._slots.values():
            if isinstance(slot.agent, AuditedAgent):
                slot.agent.round_number = round_number
        futures = {self.submit(job, deadline): index for index, job in enumerate(jobs)}
        open_ = set(futures)
        try:
            while open_:
                check()
                finished, open_ = wait(open_, POLL_S, FIRST_COMPLETED)
                for future in finished:
                    done(futures[future], future.result())
        finally:
            for future in open_:
                future.cancel()
        return [future.result() for future in futures]

    def refresh_health(self) -> None:
        """Request the judge's health, at most every HEALTH_S and without waiting; `health` is the newest answer."""
        idle = self._health_request is None or self._health_request.done()
        if idle and not self._loop.is_closed() and time.monotonic() - self._health_asked_s >= HEALTH_S:
            self._health_asked_s = time.monotonic()
            self._health_request = self._run(self._ask_health(self._first))

    def close(self) -> None:
        """Cancel open calls and end the thread."""
        with suppress(TimeoutError):
            self._run(self._end()).result(CLOSE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_S)
        self._loop.close()
        if self._log is not None:
            self._log.close()

    # internals

    @property
    def _first(self) -> _JudgeSlot:
        return next(iter(self._slots.values()))

    def _slot_of(self, task: str) -> _JudgeSlot:
        return self._slots.get(task, self._first)

    def _make_slots(self, rubric: Rubric) -> dict[str, _JudgeSlot]:
        """By task; tasks with equal settings share one."""
        made: dict[str, _JudgeSlot] = {}
        keys = {task: settings.model_dump_json() for task, settings in self._settings_of.items()}
        for task, key in keys.items():
            if key not in made:
                made[key] = self._make_slot(self._settings_of[task], rubric)
        return {task: made[key] for task, key in keys.items()}

    def _make_slot(self, settings: JudgeConfig, rubric: Rubric) -> _JudgeSlot:
        log = self._log
        limits: dict[str, Any] = {
            "mode": settings.mode, "seed": self._seed, "max_reads": settings.max_reads,
            "budget_s": settings.clip_budget_s, "call_plan": settings.call_plan,
        }
        if log is None:
            opened = make_judge(settings, rubric, self._reads, device=self._device)
            return _JudgeSlot(opened, RewardAgent(opened.judge, rubric, **limits))
        opened = make_judge(settings, rubric, self._reads, partial(write_exchange, log), device=self._device)
        return _JudgeSlot(opened, AuditedAgent(opened.judge, rubric, log, **limits))

    def _run(self, work: Coroutine[Any, Any, T]) -> "Future[T]":
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    async def _judge_clip(self, job: ClipJob, deadline: float | None) -> Verdict:
        agent = self._slot_of(job.task.task_id).agent
        if job.problem:
            verdict = _unjudged(agent, job, job.problem)
        elif refusal := self._refused.get(job.task.task_id):
            verdict = _unjudged(agent, job, refusal, Status.ABSTAIN)
        else:
            verdict = await self._evaluate(agent, job, deadline)
        self.tally.add(verdict)
        return verdict

    async def _evaluate(self, agent: RewardAgent, job: ClipJob, deadline: float | None) -> Verdict:
        deadline = math.inf if deadline is None else deadline
        async with AsyncExitStack() as place:
            try:
                async with asyncio.timeout(deadline - time.monotonic()):
                    await place.enter_async_context(self._semaphore)
                    known = self._evidence
                    evidence = {} if known is None else await asyncio.to_thread(known.evidence, job.clip, job.task)
            except TimeoutError:
                return _unjudged(agent, job, OUT_OF_ROUND)
            return await agent.evaluate(job.clip, job.task, evidence, within_s=deadline - time.monotonic())

    async def _ask_health(self, slot: _JudgeSlot) -> None:
        self.health = await slot.opened.judge.health()

    async def _end(self) -> None:
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        for slot in _distinct(self._slots):
            await slot.opened.close()


def _distinct(slots: Mapping[str, _JudgeSlot]) -> list[_JudgeSlot]:
    """Each judge once, though several tasks have it."""
    return list({id(slot): slot for slot in slots.values()}.values())


def _settings_by_task(
    settings: JudgeConfig, tasks: Iterable[str]
) -> tuple[dict[str, JudgeConfig], dict[str, str]]:
    """The settings of each task's judge, and why a task has none. Raises ValueError: not one task has a judge."""
    known: dict[str, JudgeConfig] = {}
    refused: dict[str, str] = {}
    for task in dict.fromkeys(tasks):
        try:
            known[task] = for_task(settings, task)
        except ValueError as refusal:
            refused[task] = str(refusal)
    if refused and not known:
        raise ValueError(next(iter(refused.values())))
    return known or {"": settings}, refused


def _unjudged(agent: RewardAgent, job: ClipJob, reason: str, status: Status = Status.ERROR) -> Verdict:
    """The verdict on a clip that was not judged."""
    able, now = agent.judge.capabilities, time.time()
    verdict = Verdict(
        clip_id=job.clip.clip_id, status=status, reward=math.nan, level=-1,
        stages=tuple(map(skipped_stage, GATED)), plan=None, reflections=(), hack_flags=(), cost=Cost(),
        provenance=Provenance(
            able.judge_id, able.transport, able.model, able.server_version, agent.version, "", job.clip.sha256,
            agent.seed, now, now,
        ),
        reason=reason,
    )
    return replace(verdict, audit_id=content_hash(verdict))


def buffer_jobs(
    frames: Tensor, references: Clips, sha256: str, config: VideoRlConfig, *, given: int, fps: float
) -> list[ClipJob]:
    """One job per clip of a buffer.

    The conditioning frames are shown as they were recorded, not as the video model's codec decodes them. With
    groups.hide_actions the jobs have no actions, because the recorded ones are not what the clips should show.

    Args:
        frames: decoded clips, uint8 (N, F, H, W, 3). references: the recordings of their contexts, a row per clip.
        sha256: of the buffer's file; names the clips. given: frames. fps: clip frames per second.
    """
    shown = torch.cat([references.frames[:, :given], frames[:, given:].cpu()], 1).numpy()
    first = references.frames[:, 0].numpy()
    actions = [None] * len(shown) if config.groups.hide_actions else references.actions.numpy().astype(np.float32)
    return [
        ClipJob(
            clip_ref(f"{sha256[:12]}/{row}", shown[row], fps),
            TaskSpec(references.instructions[row], config.task, config.judge.robot, first[row], actions=actions[row]),
        )
        for row in range(len(shown))
    ]


def agent_scores(verdicts: Sequence[Verdict]) -> dict[str, Tensor]:
    """The reward of each verdict, float64 (N,), NaN where there is none."""
    return {AGENT: torch.tensor([verdict.reward for verdict in verdicts], dtype=torch.float64)}


def clip_fps(bag: Path, stride: int) -> float:
    """Frames per second of clips cut from a bag at every `stride`-th frame. Raises BagError: an unusable bag."""
    return 1.0 / (read_spec(bag).control_period_s * stride)
