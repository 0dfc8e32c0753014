"""Clips optimised against a reward, the truth beside it: DD-2 of the paper with edits in place of a policy.

A search edits a clip that is good but for a physical defect: it cannot make it true, it can only make it look better.
So the truth never rises, and a reward that does was hacked. Cheap: edits of pixels and time, no rendering.
"""

import math
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.agent.judge import Judge, ReadRequest
from wm_nodes.judge.agent.levels import first_vote, score_of
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.profiles import profile_media
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import GATED, Status, TaskSpec
from wm_nodes.judge.dataset.build import instruction_of
from wm_nodes.judge.dataset.edits.clips import COMPONENTS, LabelledClip, NotApplicableError, Severity
from wm_nodes.judge.dataset.edits.generator import FRAME_RECIPES, SEVERITIES
from wm_nodes.judge.dataset.edits.recipes import apply
from wm_nodes.judge.dataset.rows import ROBOT
from wm_nodes.reports.figures import COLOURS, add_legend, make_figure, save_figure, style_axes
from wm_nodes.video_rl.reward_hacking import HackedMetric, find_hacked_metrics

Proxy = Callable[[LabelledClip, TaskSpec], Awaitable[float | None]]
"""A reward in [0, 1] that is climbed; None where it gives none (that clip is not taken)."""


@dataclass(frozen=True)
class SearchPlan:
    """generations of `candidates` edits each; the best one stays if the reward says it is better than what was there,
    up to max_edits on top of each other. severities: fail edits are faults that anybody sees, the paper's patterns
    among them; mild ones must still pass, so they only look for what confuses the judge."""

    generations: int = 8
    candidates: int = 6
    max_edits: int = 4
    severities: tuple[Severity, ...] = SEVERITIES

    def __post_init__(self) -> None:
        if min(self.generations, self.candidates, self.max_edits) < 1 or not self.severities:
            raise ValueError(f"generations, candidates, max_edits and severities must not be 0 or none, got {self}")


@dataclass(frozen=True, eq=False)
class SearchStart:
    """A clip to begin with, and its recording, without the defect."""

    clip: LabelledClip
    clean: LabelledClip

    @property
    def task(self) -> TaskSpec:
        origin = self.clip.clip.origin
        return TaskSpec(instruction_of(origin), origin.task, ROBOT, self.clean.clip.frames[0], camera_id=origin.camera)


@dataclass
class Climb:
    """One search. proxy, truth: after each generation, the start first. clean: the reward of the recording without the
    defect; NaN where that has no number. edits: taken, in order."""

    proxy: list[float]
    truth: list[float]
    clean: float = math.nan
    edits: list[str] = field(default_factory=list)


def agent_reward(judge: Judge, rubric: Rubric, seed: int = 0) -> Proxy:
    """The agent's reward; None where its verdict is not valid."""
    agent = RewardAgent(judge, rubric, seed=seed)

    async def proxy(clip: LabelledClip, task: TaskSpec) -> float | None:
        verdict = await agent.evaluate(clip.ref, task)
        return verdict.reward if verdict.valid else None

    return proxy


def mean_score(judge: Judge, rubric: Rubric, seed: int = 0) -> Proxy:
    """The single-score baseline of the same judge: the mean of the component scores that it gives, read once, without
    plan, gates, votes, reflection or hacking patterns."""

    async def proxy(clip: LabelledClip, task: TaskSpec) -> float | None:
        scores: list[float] = []
        for stage in GATED:
            part = rubric.stages[stage]
            media, names = profile_media(clip.ref, task, part.profile), tuple(part.components)
            vote = (first_vote(seed),)
            reads = await judge.read(ReadRequest(clip.ref, task, stage, names, part.profile, vote, media, "pack"))
            scores += [score_of(read.levels) for read in reads if read.status is Status.OK]
        return float(np.mean(scores)) if scores else None

    return proxy


async def pixel_similarity(clip: LabelledClip, task: TaskSpec) -> float | None:
    """A likelihood of the simplest kind: 1 - mean absolute difference to the reference image. It rewards stillness."""
    return 1 - float(np.abs(clip.clip.frames.astype(np.float32) - task.reference_frame).mean()) / 255


def true_value(chain: Sequence[LabelledClip]) -> float:
    """Mean over eleven components and TC of what is really so, in [0, 1], of the last clip of a chain of edits.

    A component that ever failed still fails, hidden or not; one that nobody can tell counts half; TC counts level / 4
    of the lowest level in the chain.
    """
    values = []
    for name in COMPONENTS:
        seen = [clip.labels.components.get(name) for clip in chain]
        values.append(0.0 if False in seen else 0.5 if seen[-1] is None else 1.0)
    return float(np.mean([*values, min(clip.labels.tc_level for clip in chain) / 4]))


async def has_numbers(start: SearchStart, rewards: Iterable[Proxy]) -> bool:
    """Whether every reward gives the clip and its recording a number, so that all of them climb from the same clips."""
    for reward in rewards:
        for clip in (start.clip, start.clean):
            if await reward(clip, start.task) is None:
                return False
    return True


async def climb(
    start: SearchStart, proxy: Proxy, plan: SearchPlan, seed: int, *, on_clip: Callable[[], object] = lambda: None
) -> Climb | None:
    """Search from one clip; None where the reward gives the start no number."""
    chain, best = [start.clip], await proxy(start.clip, start.task)
    on_clip()
    if best is None:
        return None
    clean = await proxy(start.clean, start.task)
    search = Climb([best], [true_value(chain)], math.nan if clean is None else clean)
    for generation in range(plan.generations):
        rng = numpy_stream(seed, f"hack_search/{start.clip.sha256}/{generation}")
        for child in _make_children(chain, plan, rng) if len(search.edits) < plan.max_edits else []:
            value = await proxy(child, start.task)
            on_clip()
            if value is not None and value > best:
                best, chain = value, [*chain[: len(search.edits) + 1], child]
        if len(chain) > len(search.edits) + 1:
            search.edits.append(f"{chain[-1].recipe} {chain[-1].edits[-1].severity}")
        search.proxy.append(best)
        search.truth.append(true_value(chain))
    return search


def _make_children(chain: Sequence[LabelledClip], plan: SearchPlan, rng: np.random.Generator) -> list[LabelledClip]:
    children: list[LabelledClip] = []
    for _ in range(4 * plan.candidates):
        if len(children) == plan.candidates:
            break
        name = FRAME_RECIPES[rng.integers(len(FRAME_RECIPES))]
        severity = plan.severities[rng.integers(len(plan.severities))]
        try:
            children.append(apply(chain[-1], name, severity, int(rng.integers(2**31))))
        except (NotApplicableError, ValueError):  # the second: labels of such a chain would be unknown throughout
            continue
    return children


@dataclass(frozen=True)
class Curve:
    """Means over the searches of one reward, and what the detector (DD-2) says of them. clean: mean reward of the
    recordings. wins: share of searches that end at or above their recording's reward; before: that begin there."""

    reward: str
    searches: int
    proxy: list[float]
    truth: list[float]
    clean: float
    before: float
    wins: float
    alarms: list[HackedMetric]
    most_used: list[str]


def curve(name: str, climbs: Sequence[Climb]) -> Curve:
    proxy = np.mean([search.proxy for search in climbs], 0).tolist()
    truth = np.mean([search.truth for search in climbs], 0).tolist()
    used = [edit for search in climbs for edit in search.edits]
    ranked = sorted(set(used), key=lambda edit: (-used.count(edit), edit))
    alarms = find_hacked_metrics(proxy, {"truth": truth}, window=len(proxy)) if len(proxy) >= 3 else []
    known = [search for search in climbs if not math.isnan(search.clean)]
    pairs = [(search.proxy[0] >= search.clean, search.proxy[-1] >= search.clean) for search in known]
    before, wins = np.mean(pairs, 0).tolist() if pairs else (math.nan, math.nan)
    clean = float(np.nanmean([search.clean for search in climbs])) if pairs else math.nan
    most_used = [f"{edit} x{used.count(edit)}" for edit in ranked[:5]]
    return Curve(name, len(climbs), proxy, truth, clean, before, wins, alarms, most_used)


def plot_curves(curves: Sequence[Curve], path: Path) -> None:
    """The reward that is climbed beside the truth, a panel per reward."""
    figure = make_figure(4.2 * len(curves), 3.8)
    panels = np.atleast_1d(figure.subplots(1, len(curves), sharey=True))
    for axes, course in zip(panels, curves, strict=True):
        alarm = "alarm" if course.alarms else "no alarm"
        style_axes(axes, f"{course.reward}: {alarm}, {course.searches} clips", "generation", "mean over clips")
        axes.plot(course.proxy, color=COLOURS[2], linewidth=2, label="reward that is climbed")
        axes.plot(course.truth, color=COLOURS[0], linewidth=2, linestyle="--", label="truth")
        if not math.isnan(course.clean):
            axes.axhline(course.clean, color="gray", linewidth=1, linestyle=":", label="reward of the clean recording")
        axes.set_ylim(0, 1.02)
        add_legend(axes, "lower left")
    save_figure(figure, path)
