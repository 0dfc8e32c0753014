"""The state machine of the reward agent (RA-1).

PRECHECK -> PLAN -> VQ -> IF -> TC -> PC -> REFLECT -> HACK -> AGGREGATE. In reward mode a failed gate ends the reading;
in benchmark mode every component is read. If reflection opens a closed gate, the stages after it are read, too, once.
Of audited clips the hacking patterns are read behind a closed gate, too. Mode topreward reads one probability instead
(topreward.py). The result is always a Verdict; its reward is NaN where the judge fails or abstains.
"""

import asyncio
import hashlib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Literal

from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.agent import levels, reflection, scoring, topreward
from wm_nodes.judge.agent.judge import ComponentScore, Cost, Judge, JudgeError, MediaItem, Read, ReadRequest, Vote
from wm_nodes.judge.agent.precheck import precheck
from wm_nodes.judge.agent.profiles import DENSE_MAX, Energy, cited_media, frame_energy, profile_media
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import (
    GATED,
    NUM_PLAN_LEVELS,
    PLANNING,
    TASK_COMPLETION,
    ClipRef,
    Component,
    Evidence,
    Profile,
    Stage,
    Status,
    TaskSpec,
)
from wm_nodes.judge.agent.verdict import (
    Change,
    HackFlag,
    PlanResult,
    Provenance,
    Reflection,
    StageScore,
    Verdict,
    content_hash,
)

Mode = Literal["reward", "benchmark", "topreward"]
CallPlan = Literal["pack", "fanout", "auto"]
OUT_OF_ROUND = "no verdict by the round's deadline"


class RewardAgent:
    """Judges clips one by one; calls of different clips may run at the same time."""

    def __init__(
        self, judge: Judge, rubric: Rubric, *, mode: Mode = "reward", seed: int = 0, max_reads: int = 60,
        budget_s: float = 300.0, call_plan: CallPlan = "auto",
    ) -> None:
        """Join a judge and a rubric.

        Args:
            seed: of option orders and random audits; equal seeds and answers give equal verdicts.
            max_reads: per clip, all reads counted; votes and second looks are given up before it is exceeded.
            budget_s: per clip, wall clock; a clip that takes longer is an ERROR.

        Raises:
            ValueError: the judge lacks a component or takes one image only, or max_reads does not cover one read of
                everything.
        """
        self.judge, self.rubric, self.mode, self.seed, self.call_plan = judge, rubric, mode, seed, call_plan
        self.max_reads, self.budget_s = max_reads, budget_s
        patterns = rubric.hack.patterns if rubric.hack.enabled else ()
        staged = mode != topreward.MODE
        needed = {PLANNING, *rubric.component_names, *patterns} if staged else {TASK_COMPLETION}
        can = judge.capabilities.components
        if can is not None and needed - can:
            raise ValueError(f"judge {judge.capabilities.judge_id} does not read {', '.join(sorted(needed - can))}")
        if judge.capabilities.max_frames < 2:
            raise ValueError(f"a judge must see 2 frames or more, it takes {judge.capabilities.max_frames}")
        smallest = 1 + len(rubric.component_names) + 2 * len(patterns) if staged else 1
        if max_reads < smallest:
            raise ValueError(f"max_reads must be >= {smallest}, one read of everything, got {max_reads}")
        if not budget_s > 0:
            raise ValueError(f"budget_s must be > 0, got {budget_s}")

    @property
    def version(self) -> str:
        """Of the words that the judge is asked in: the rubric's, or that of mode topreward."""
        return topreward.VERSION if self.mode == topreward.MODE else self.rubric.version

    async def evaluate(
        self, clip: ClipRef, task: TaskSpec, evidence: Evidence | None = None, *, within_s: float = math.inf
    ) -> Verdict:
        """Judge one clip. evidence: causes votes and second looks, nothing else. within_s: what its round has left."""
        started, clock = time.time(), time.monotonic()
        run = _Run(self, clip, task, evidence or {})
        try:
            async with asyncio.timeout(min(self.budget_s, within_s)):
                status, value, reason = await run.judge_clip()
        except _Stop as stop:
            status, value, reason = stop.status, math.nan, str(stop)
        except TimeoutError:
            reason = OUT_OF_ROUND if within_s < self.budget_s else f"no verdict within {self.budget_s:g} s"
            status, value = Status.ERROR, math.nan
        able = self.judge.capabilities
        verdict = Verdict(
            clip_id=clip.clip_id,
            status=status,
            reward=value,
            level=run.level,
            stages=tuple(run.stages.values()),
            plan=run.plan,
            reflections=tuple(run.reflections),
            hack_flags=tuple(run.flags),
            cost=replace(run.cost, wall_s=time.monotonic() - clock),
            provenance=Provenance(
                able.judge_id, able.transport, able.model, able.server_version, self.version,
                hashlib.sha256("".join(run.prompts).encode()).hexdigest(), clip.sha256, self.seed, started, time.time(),
            ),
            reason=reason,
            num_reads=run.num_reads,
        )
        return replace(verdict, audit_id=content_hash(verdict))


class _Stop(Exception):
    """Ends the evaluation of a clip with a verdict without a reward."""

    def __init__(self, status: Status, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class _Run:
    """The evaluation of one clip."""

    def __init__(self, agent: RewardAgent, clip: ClipRef, task: TaskSpec, evidence: Evidence) -> None:
        self.agent, self.rubric, self.clip, self.task, self.evidence = agent, agent.rubric, clip, task, evidence
        self.stages: dict[Stage, StageScore] = {stage: scoring.skipped_stage(stage) for stage in GATED}
        self.plan: PlanResult | None = None
        self.level = -1
        self.reflections: list[Reflection] = []
        self.flags: list[HackFlag] = []
        self.cost, self.num_reads, self.prompts = Cost(), 0, list[str]()
        self._media: dict[Profile, tuple[MediaItem, ...]] = {}
        self._audited = self._is_drawn("audit", self.rubric.voting.audit_share)

    async def judge_clip(self) -> tuple[Status, float, str]:
        """Go through every state. Raises _Stop where the judge fails or, in reward mode, cannot say."""
        check = precheck(self.clip, self.task)
        if check.kind == "malformed":
            return Status.ERROR, math.nan, check.reason
        if check.kind == "no video":
            self.level = 0
            return Status.OK, 0.0, check.reason
        if self.agent.mode == topreward.MODE:
            return await self._read_truth()
        self.plan = plan = await self._read_plan()
        self.level = plan.level
        await self._read_stages(plan)
        if self.rubric.reflection.enabled:
            await self._reflect(plan)
            await self._read_stages(plan)
        all_read = all(self.stages[stage].status is not Status.SKIPPED for stage in self.rubric.gated)
        if self.rubric.hack.enabled and (all_read or self._audited):
            await self._read_patterns()
            confirmed = [flag.pattern for flag in self.flags if flag.confirmed]
            self.stages = {s.stage: s for s in scoring.apply_caps(self._stages_in_order(), confirmed, self.rubric)}
        self._refuse_letters_alone()
        silent = [c.reason for s in self._stages_in_order() for c in s.components if c.status is Status.ABSTAIN]
        if silent:
            return Status.ABSTAIN, math.nan, "; ".join(silent)
        return Status.OK, scoring.reward(plan.weights, self._stages_in_order(), self.rubric), ""

    async def _read_truth(self) -> tuple[Status, float, str]:
        """One stage with one component whose s is p("True"); it gates nothing."""
        media = topreward.shown_frames(self.clip, self.agent.judge.capabilities.max_frames)
        vote = topreward.vote(self.agent.seed)
        (read,) = await self._ask(Stage.TC, (TASK_COMPLETION,), vote, Profile.D, media=media)
        score = self._score_read(read)
        self.stages = {Stage.TC: StageScore(Stage.TC, score.status, score.s, score.status is Status.OK, (score,))}
        return score.status, score.s, score.reason

    async def _read_plan(self) -> PlanResult:
        (read,) = await self._ask(Stage.PLAN, (PLANNING,), levels.first_vote(self.agent.seed), Profile.S)
        status, reason = levels.state_of(read, self.rubric.voting.min_label_mass, NUM_PLAN_LEVELS)
        if status is not Status.OK:
            raise _Stop(status, reason)
        return scoring.plan_result(read, self.rubric)

    async def _read_stages(self, plan: PlanResult) -> None:
        """Read the stages not read yet, up to the first closed gate in reward mode."""
        for stage in self.rubric.gated:
            if self.stages[stage].status is Status.SKIPPED:
                self.stages[stage] = score = await self._read_stage(stage, plan)
                reasons = [part.reason for part in score.components if part.status is score.status]
                if score.status is Status.ERROR or (score.status is Status.ABSTAIN and self.agent.mode == "reward"):
                    raise _Stop(score.status, "; ".join(reasons))
            if self.agent.mode == "reward" and not scoring.gate_is_open(self.stages[stage], self.rubric):
                return

    async def _read_stage(self, stage: Stage, plan: PlanResult) -> StageScore:
        described, min_label_mass = self.rubric.stages[stage], self.rubric.voting.min_label_mass
        focus = [name for name in plan.focus if name in described.components]
        names = tuple(dict.fromkeys([*focus, *described.components]))
        first = await self._ask(stage, names, levels.first_vote(self.agent.seed), described.profile)
        reads = {read.component: [read] for read in first}
        voted = self._select_voted(reads, plan)
        scores: dict[Component, ComponentScore] = {}
        for name in names:
            score = self._tally(reads[name]) if name in voted else self._score_read(reads[name][0])
            if score is not None:
                scores[name] = score
        while unclear := [name for name in names if name not in scores]:
            granted = tuple(unclear[: self._spare_reads(stage)])
            for name in unclear[len(granted) :]:
                scores[name] = levels.settle(reads[name], min_label_mass)
            if granted:
                vote = levels.next_vote(len(reads[granted[0]]), self.agent.seed)
                for read in await self._ask(stage, granted, vote, described.profile):
                    reads[read.component].append(read)
            for name in granted:
                if (score := self._tally(reads[name])) is not None:
                    scores[name] = score
        return scoring.stage_score(stage, [scores[name] for name in described.components], self.rubric)

    def _select_voted(self, reads: Mapping[Component, list[Read]], plan: PlanResult) -> set[Component]:
        """Activation: the unclear ones and those against evidence; all at a middling planning level or for audit."""
        rules = self.rubric.voting
        if self._audited or plan.level in rules.levels:
            return set(reads)
        suspected = set(reflection.conflicting(self.evidence))
        looks = {name: self._score_read(first) for name, (first,) in reads.items()}
        return {name for name, look in looks.items() if look.margin < rules.clear_margin or name in suspected}

    def _tally(self, reads: Sequence[Read]) -> ComponentScore | None:
        rules = self.rubric.voting
        return levels.tally(reads, k=rules.k, k_max=rules.k_max, min_label_mass=rules.min_label_mass)

    def _score_read(self, read: Read) -> ComponentScore:
        """The score of a single read, or why it has none."""
        return levels.settle([read], self.rubric.voting.min_label_mass)

    async def _reflect(self, plan: PlanResult) -> None:
        stages = self._stages_in_order()
        drawn = self._is_drawn("reflect", self.rubric.reflection.audit_share)
        reasons = reflection.triggers(plan, stages, self.rubric, self.evidence, drawn=drawn)
        names = reflection.suspects(reasons, stages, self.rubric.reflection.max_changes)
        last_read = [stage.stage for stage in stages if stage.status is not Status.SKIPPED][-1]
        if not reasons or 2 * len(names) > self._spare_reads(last_read) or not names:
            return
        before = {score.component: score for stage in stages for score in stage.components}
        vote = levels.first_vote(self.agent.seed)
        second = await self._ask(Stage.REFLECT, names, vote, Profile.D, prior=tuple(before.values()))
        changes = [change for read in second if (change := await self._check_change(before[read.component], read))]
        self.reflections.append(Reflection(tuple(trigger.reason for trigger in reasons), tuple(changes)))

    async def _check_change(self, before: ComponentScore, second: Read) -> Change | None:
        """Check one proposal with a fresh label read on the frames it cites, and take it over if that agrees."""
        look = self._score_read(second)
        if look.status is Status.ERROR:
            raise _Stop(Status.ERROR, look.reason)
        if look.status is not Status.OK or not reflection.proposes_change(before, second, len(self.clip.frames)):
            return None
        stage, media = self.rubric.stage_of(before.component), cited_media(second.frames_cited, self.clip)
        vote = levels.next_vote(len(before.votes), self.agent.seed)
        (fresh,) = await self._ask(stage, (before.component,), vote, Profile.D, media=media)
        checked = self._score_read(fresh)
        if checked.status is Status.ERROR:
            raise _Stop(Status.ERROR, checked.reason)
        accepted = checked.status is Status.OK and reflection.is_confirmed(before, second, fresh)
        after = levels.score([second, fresh], "reflection") if accepted else look
        if accepted:
            taken = replace(after, votes=(*before.votes, second, fresh))
            scores = [taken if c.component == before.component else c for c in self.stages[stage].components]
            self.stages[stage] = scoring.stage_score(stage, scores, self.rubric)
        reason = second.reason or second.evidence_text
        return Change(before.component, before.s, after.s, reason, second.frames_cited, accepted)

    def _refuse_letters_alone(self) -> None:
        """Raise _Stop(ERROR) where every first read was asked for as JSON and is a letter, its answer being refused."""
        first = [c.votes[0] for s in self._stages_in_order() for c in s.components if c.votes]
        if first and all(read.source == "label" and read.vote.kind == "json" for read in first):
            why = first[0].reason
            raise _Stop(Status.ERROR, f"no JSON answer was accepted, and letters alone are no judgement: {why}")

    async def _read_patterns(self) -> None:
        """Read every hacking pattern once, and those that seem present again, which must be another question.

        Where the first reads are letters, JSON being refused, they asked for defects worst first, as vote 1 does.
        """
        rules, names = self.rubric.hack, tuple(self.rubric.hack.patterns)
        if not names:
            return
        first = await self._ask(Stage.HACK, names, levels.first_vote(self.agent.seed), Profile.D)
        present = {read.component: self._p_present(read) for read in first}
        seen = tuple(name for name in names if present[name] >= rules.confirm)
        vote = levels.next_vote(2 if any(read.source == "label" for read in first) else 1, self.agent.seed)
        again = await self._ask(Stage.HACK, seen, vote, Profile.D) if seen else []
        confirmed = {read.component for read in again if self._p_present(read) >= rules.confirm}
        texts = {read.component: read.evidence_text for read in first}
        self.flags = [HackFlag(name, present[name], name in confirmed, texts[name]) for name in names]

    def _p_present(self, read: Read) -> float:
        """Probability of a pattern; NaN, which confirms nothing, where the judge cannot say."""
        look = self._score_read(read)
        if look.status is Status.ERROR:
            raise _Stop(Status.ERROR, look.reason)
        return look.p_fail

    async def _ask(
        self, stage: Stage, names: tuple[Component, ...], vote: Vote, profile: Profile, *,
        media: tuple[MediaItem, ...] | None = None, prior: Sequence[ComponentScore] = (),
    ) -> list[Read]:
        """One question to the judge, answered in the order of `names`. Raises _Stop(ERROR) where it is not."""
        images = self._media_of(profile) if media is None else media
        plan = self.agent.call_plan
        request = ReadRequest(self.clip, self.task, stage, names, profile, (vote,), images, plan, prior)
        self.num_reads += len(names)
        try:
            reads = await self.agent.judge.read(request)
        except JudgeError as error:
            self.cost += error.cost
            raise _Stop(Status.ERROR, f"{stage}: {error}") from error
        except Exception as error:  # a judge is external code: whatever it raises, this clip has no reward
            raise _Stop(Status.ERROR, f"{stage}: judge raised {type(error).__name__}: {error}") from error
        self.cost = sum((read.cost for read in reads), self.cost)
        self.prompts += [read.prompt_sha for read in reads]
        answered = {read.component: read for read in reads if read.vote == vote}
        if len(reads) != len(names) or set(answered) != set(names):
            got = ", ".join(f"{read.component}/{read.vote.index}" for read in reads)
            asked = ", ".join(f"{name}/{vote.index}" for name in names)
            raise _Stop(Status.ERROR, f"{stage}: asked for {asked}, the judge answered {got or 'nothing'}")
        return [answered[name] for name in names]

    @cached_property
    def _energy(self) -> Energy:
        return frame_energy(self.clip.frames)

    def _media_of(self, profile: Profile) -> tuple[MediaItem, ...]:
        if profile not in self._media:
            most = self.agent.judge.capabilities.max_frames
            most_dense = min(DENSE_MAX, most)
            media = profile_media(self.clip, self.task, profile, motion=self._energy, max_frames=most_dense)
            if len(media) > most:
                raise _Stop(Status.ERROR, f"profile {profile}: {len(media)} images, the judge takes {most} in a call")
            self._media[profile] = media
        return self._media[profile]

    def _spare_reads(self, stage: Stage) -> int:
        """Reads that may be spent on votes now: what is left after one read of everything behind `stage`."""
        behind = self.rubric.gated[self.rubric.gated.index(stage) + 1 :]
        reserved = sum(len(self.rubric.stages[later].components) for later in behind)
        reserved += 2 * len(self.rubric.hack.patterns) if self.rubric.hack.enabled else 0
        return max(0, self.agent.max_reads - self.num_reads - reserved)

    def _stages_in_order(self) -> tuple[StageScore, ...]:
        return tuple(self.stages[stage] for stage in GATED)

    def _is_drawn(self, name: str, share: float) -> bool:
        """A seeded draw of a share of the clips, by content."""
        return bool(numpy_stream(self.agent.seed, f"{name}/{self.clip.sha256}").random() < share)
