"""Ask a judge about the check set: a few questions twice, then every clip in mode reward and in mode benchmark."""

import asyncio
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.core.device import CPU
from wm_nodes.judge.agent.judge import ForwardingJudge, Judge, JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.levels import first_vote, next_vote
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.profiles import profile_media
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import Stage, Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.factory import check_clips, for_task, make_judge
from wm_nodes.judge.check_set import LabelledClip

Mode = Literal["reward", "benchmark"]
MODES: tuple[Mode, ...] = ("reward", "benchmark")
"""In this order: the second finds the answers of the first among those that are kept."""
PROBED = 12
"""Clips about which the same is asked twice."""


class KeepingJudge(ForwardingJudge):
    """A Judge that passes everything on and keeps the reads."""

    def __init__(self, judge: Judge) -> None:
        super().__init__(judge)
        self.reads, self.failures = list[Read](), list[str]()

    async def read(self, request: ReadRequest) -> list[Read]:
        try:
            reads = await super().read(request)
        except JudgeError as error:
            self.failures.append(str(error))
            raise
        self.reads += reads
        return reads


@dataclass(frozen=True)
class Judged:
    """The verdict on one clip in one mode."""

    clip: LabelledClip
    """With its label."""
    mode: Mode
    """Of the agent."""
    verdict: Verdict
    """Of the agent."""
    fresh: bool
    """No answer was a kept one, so that its time counts."""


@dataclass
class CheckRun:
    """Everything that a judge answered."""

    rubric: Rubric
    """By which was judged."""
    judged: list[Judged] = field(default_factory=list)
    """In the order of their ends."""
    not_judged: dict[str, str] = field(default_factory=dict)
    """clip_id to the reason, of clips that the judge cannot read at all."""
    reads: list[Read] = field(default_factory=list)
    """Of all questions, those asked twice included."""
    failures: list[str] = field(default_factory=list)
    """Why a question had no answer at all."""
    measured: dict[str, float] = field(default_factory=dict)
    """Of the questions asked twice, by the names of Health.details."""


def choose(clips: Sequence[LabelledClip], count: int) -> list[LabelledClip]:
    """At most `count` clips, evenly from parts, families, successes and failures."""
    known = sorted(clips, key=lambda c: (c.truth.part, c.truth.family, c.truth.success, c.truth.clip_id))
    count = min(count, len(known))
    return [known[math.floor((index + 0.5) * len(known) / count)] for index in range(count)]


def run_check(
    settings: JudgeConfig, clips: Sequence[LabelledClip], *, reads: Path, seed: int = 0, device: str = CPU,
    done: Callable[[], None] = lambda: None,
) -> CheckRun:
    """Ask the judge.

    Args:
        reads: folder that keeps a server's answers; a second run asks only what is not there.
        done: called once per clip and mode.

    Raises:
        ValueError: as make_judge; the server does not answer, or serves another model.
    """
    run = CheckRun(load_rubric(settings.rubric))
    for chosen, group in _by_judge(settings, clips, run, done):
        asyncio.run(_Check(chosen, run, reads, seed, device, done).ask(group))
    return run


def _by_judge(
    settings: JudgeConfig, clips: Iterable[LabelledClip], run: CheckRun, done: Callable[[], None]
) -> list[tuple[JudgeConfig, list[LabelledClip]]]:
    """The clips by the judge that reads them: a server reads all, an embedded one those of its size."""
    groups: dict[str, tuple[JudgeConfig, list[LabelledClip]]] = {}
    for clip in clips:
        shown = clip.job.clip
        try:
            chosen = for_task(settings, clip.job.task.task_id)
            check_clips(chosen, shown.frames.shape, shown.fps)
        except ValueError as refusal:
            run.not_judged[clip.truth.clip_id] = str(refusal)
            for _ in MODES:
                done()
            continue
        groups.setdefault(chosen.folder, (chosen, []))[1].append(clip)
    return list(groups.values())


class _Check:
    """One judge and its clips."""

    def __init__(
        self, settings: JudgeConfig, run: CheckRun, reads: Path, seed: int, device: str, done: Callable[[], None]
    ) -> None:
        self._settings, self._run, self._seed, self._done = settings, run, seed, done
        self._opened = make_judge(settings, run.rubric, reads, device=device)
        twice = settings.model_copy(update={"repeat_share": 1.0, "keep_reads": False})
        self._twice = make_judge(twice, run.rubric, device=device)
        self._turn = asyncio.Semaphore(settings.concurrency)

    async def ask(self, clips: Sequence[LabelledClip]) -> None:
        try:
            if not (health := await self._opened.judge.health()).available:
                raise ValueError(f"the judge does not answer: {health.reason}; start it (wm judge serve-help says how)")
            await asyncio.gather(*map(self._ask_twice, choose(clips, PROBED)))
            self._run.measured |= (await self._twice.judge.health()).details
            for mode in MODES:
                await asyncio.gather(*(self._judge(clip, mode) for clip in clips))
        finally:
            await self._opened.close()
            await self._twice.close()

    async def _ask_twice(self, clip: LabelledClip) -> None:
        """The first stage's components, each by an answer with reasons and by a letter."""
        judge, (clip_ref, task) = KeepingJudge(self._twice.judge), (clip.job.clip, clip.job.task)
        stage, described = next(iter(self._run.rubric.stages.items()))
        votes = (first_vote(self._seed), next_vote(1, self._seed))
        media = profile_media(clip_ref, task, described.profile)
        request = ReadRequest(
            clip_ref, task, Stage(stage), tuple(described.components), described.profile, votes, media,
            self._settings.call_plan,
        )
        async with self._turn:
            with suppress(JudgeError):  # it is among the failures
                await judge.read(request)
        self._keep(judge)

    async def _judge(self, clip: LabelledClip, mode: Mode) -> None:
        judge, settings = KeepingJudge(self._opened.judge), self._settings
        agent = RewardAgent(
            judge, self._run.rubric, mode=mode, seed=self._seed, max_reads=settings.max_reads,
            budget_s=settings.clip_budget_s, call_plan=settings.call_plan,
        )
        async with self._turn:
            verdict = await agent.evaluate(clip.job.clip, clip.job.task)
        self._keep(judge)
        self._done()
        unread = all(stage.status is Status.SKIPPED for stage in verdict.stages)
        if settings.kind == "embedded" and verdict.status is Status.ABSTAIN and unread:
            self._run.not_judged[clip.truth.clip_id] = verdict.reason
            return
        fresh = all(read.cost.wall_s > 0 for read in judge.reads if read.cost.calls)
        self._run.judged.append(Judged(clip, mode, verdict, fresh))

    def _keep(self, judge: KeepingJudge) -> None:
        self._run.reads += judge.reads
        self._run.failures += judge.failures
