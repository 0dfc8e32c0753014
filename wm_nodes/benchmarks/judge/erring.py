"""What planning, gates, votes and reflection gain and cost under a judge that errs at a known rate.

The judge knows the labels of the clips (label_judge.py). Every way of judging meets the same errors, so that ways are
compared in pairs; intervals are Student's, of 95 %, over seeds of the errors, on these clips.
"""

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.experiment import Count, Experiment, console
from benchmarks.judge.call_counter import CountingJudge
from benchmarks.judge.label_judge import ClipLabels, Errors, LabelJudge
from wm_nodes.core.progress import tqdm
from wm_nodes.core.statistics import balanced_accuracy, t_interval
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.check_set import CHECK_SET, LabelledClip, load_check_set
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.paper_table import FAIR_LEVEL
from wm_nodes.reports.console_table import estimate, make_table

AGENT = "agent"
PACKS = {
    AGENT: "robot", "no planning": "robot_no_planning", "no gates": "robot_open_gates", "no votes": "robot_no_votes",
    "no reflection": "robot_no_reflection", "neither": "robot_single_read", "all voted": "robot_all_votes",
}
"""Ways of judging: the rubric pack of each. neither: no votes and no reflection."""
AUDITED = {"nothing": (0, 0), "votes": (1, 0), "looks": (0, 1)}
"""Audit shares of votes and of second looks: of no clip, or of all, for the cost and finds per audited clip."""
RATES, SHARES, AUDIT_RATE = (0.05, 0.1, 0.2), (0.0, 0.5, 1.0), 0.1
MEASURES = ("accuracy", "components", "faults_accepted", "successes_kept", "silent", "calls", "images")


@dataclass(kw_only=True)
class Erring(Experiment):
    """What planning, gates, votes and reflection gain and cost under a judge that errs at a known rate."""

    check_set: Path = CHECK_SET
    """Folder of labelled clips; without, the shipped ones."""
    seeds: Count = 20
    """Of the errors, 2 at least."""

    def run(self) -> None:
        clips, rubric = load_check_set(self.check_set), load_rubric(PACKS[AGENT])
        settings = [Errors(*one) for one in product(RATES, SHARES, (True, False))]
        ways = asyncio.run(compare_ways(clips, settings, self.seeds))
        audited = [errors for errors in settings if errors.rate == AUDIT_RATE]
        audits = asyncio.run(measure_audits(clips, audited, self.seeds))
        for start in range(0, len(ways), len(PACKS)):
            console.print(ways_table(ways[start : start + len(PACKS)]))
        console.print(audit_table(audits))
        self.write({
            "experiment": "erring", "clips": len(clips), "faults": sum(clip.truth.is_fault for clip in clips),
            "successes": sum(clip.truth.success for clip in clips), "seeds": self.seeds, "packs": PACKS,
            "rubric": rubric.version, "ways": ways, "audits": audits,
            "audit_shares": {"votes": rubric.voting.audit_share, "looks": rubric.reflection.audit_share},
        })


@dataclass(frozen=True)
class Judged:
    """One clip, judged once."""

    accepted: bool | None
    """None without a verdict."""
    passed: Mapping[str, bool]
    """Decision by component."""
    flags: frozenset[str]
    """Confirmed hacking patterns."""
    calls: int
    """Asked of the judge."""
    images: int
    """In those calls."""


def labels_of(clips: Iterable[LabelledClip]) -> dict[str, ClipLabels]:
    """What the judge knows, by clip; a planning level that nobody can tell is fair."""
    return {
        clip.job.clip.sha256: ClipLabels(
            clip.truth.components, FAIR_LEVEL if clip.truth.planning is None else clip.truth.planning,
            clip.truth.completion, frozenset(clip.truth.patterns),
        )
        for clip in clips
    }


async def judge_clips(clips: Sequence[LabelledClip], judge: LabelJudge, rubric: Rubric, seed: int) -> list[Judged]:
    """Every clip by the agent in reward mode. seed: of the agent: which clips are audited."""
    found = []
    for clip in clips:
        counter = CountingJudge(judge)
        agent = RewardAgent(counter, rubric, seed=seed, call_plan="pack")
        verdict = await agent.evaluate(clip.job.clip, clip.job.task)
        scores = [score for stage in verdict.stages for score in stage.components if score.status is Status.OK]
        found.append(Judged(
            accepts(verdict) if verdict.valid else None, {score.component: score.passed for score in scores},
            frozenset(flag.pattern for flag in verdict.hack_flags if flag.confirmed),
            counter.calls, counter.images,
        ))
    return found


def measured(clips: Sequence[LabelledClip], found: Sequence[Judged], rubric: Rubric) -> dict[str, float]:
    """MEASURES of one pass over the clips. accuracy: share of clips accepted or refused as labelled; one without
    a verdict is not. components: balanced accuracy, mean over the components, of the clips where each was read.
    """
    accepted = np.array([one.accepted is True for one in found])
    silent = np.array([one.accepted is None for one in found])
    success, fault = (np.array([getattr(c.truth, name) for c in clips]) for name in ("success", "is_fault"))
    truths = [clip.truth.rows(rubric) for clip in clips]
    balanced = []
    for name in rubric.component_names:
        read = [(truth[name], one.passed[name]) for truth, one in zip(truths, found) if name in one.passed]
        known = [(label, passed) for label, passed in read if label is not None]
        balanced.append(balanced_accuracy([label for label, _ in known], [passed for _, passed in known]))
    return {
        "accuracy": float(((accepted == success) & ~silent).mean()), "components": float(np.nanmean(balanced)),
        "faults_accepted": float(accepted[fault].mean()), "successes_kept": float(accepted[success].mean()),
        "silent": float(silent.mean()), "calls": float(np.mean([one.calls for one in found])),
        "images": float(np.mean([one.images for one in found])),
    }


async def compare_ways(clips: Sequence[LabelledClip], settings: Sequence[Errors], seeds: int) -> list[dict[str, Any]]:
    """A row per setting and way: every measure, and its difference to the agent, each (mean, low, high) over seeds."""
    rubrics = {way: load_rubric(pack) for way, pack in PACKS.items()}
    known, values = labels_of(clips), dict[tuple[Errors, str], list[dict[str, float]]]()
    with tqdm(total=seeds * len(settings) * len(rubrics), desc="judged", unit="set") as bar:
        for seed in range(seeds):
            judge = LabelJudge(known, rubrics[AGENT], seed=seed)
            for judge.errors, (way, rubric) in product(settings, rubrics.items()):
                found = await judge_clips(clips, judge, rubric, seed)
                values.setdefault((judge.errors, way), []).append(measured(clips, found, rubric))
                bar.update()
    return [
        {
            **asdict(errors), "way": way, **{name: interval([one[name] for one in of_way]) for name in MEASURES},
            "difference": {} if way == AGENT else {
                name: interval([one[name] - base[name] for one, base in zip(of_way, values[errors, AGENT])])
                for name in MEASURES
            },
        }
        for (errors, way), of_way in values.items()
    ]


async def measure_audits(clips: Sequence[LabelledClip], settings: Sequence[Errors], seeds: int) -> list[dict[str, Any]]:
    """A row per setting and kind of audit: what an audited clip costs more and what that finds, (mean, low, high).

    mended, spoiled: clips decided rightly only with, and only without the audit. hacks: clips with a hacking pattern of
    theirs confirmed that would not be without; false_hacks: with one that is not there.
    """
    rubrics = {
        name: load_rubric(overrides={"voting": {"audit_share": votes}, "reflection": {"audit_share": looks}})
        for name, (votes, looks) in AUDITED.items()
    }
    known, values = labels_of(clips), dict[tuple[Errors, str], list[dict[str, float]]]()
    for seed in range(seeds):
        judge = LabelJudge(known, rubrics["nothing"], seed=seed)
        for judge.errors in settings:
            found = {name: await judge_clips(clips, judge, rubric, seed) for name, rubric in rubrics.items()}
            for name in ("votes", "looks"):
                gains = [_gain(c, *pair) for c, *pair in zip(clips, found["nothing"], found[name])]
                means = {key: float(np.mean([gain[key] for gain in gains])) for key in gains[0]}
                values.setdefault((judge.errors, name), []).append(means)
    return [
        {**asdict(errors), "audit": name, **{key: interval([one[key] for one in of_kind]) for key in of_kind[0]}}
        for (errors, name), of_kind in values.items()
    ]


def _gain(clip: LabelledClip, before: Judged, after: Judged) -> dict[str, float]:
    was_right, is_right = (one.accepted is clip.truth.success for one in (before, after))
    new, there = after.flags - before.flags, frozenset(clip.truth.patterns)
    return {
        "calls": after.calls - before.calls, "images": after.images - before.images,
        "mended": is_right and not was_right, "spoiled": was_right and not is_right,
        "hacks": bool(new & there), "false_hacks": bool(new - there),
    }


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    found = t_interval(values)
    return found.mean, found.low, found.high


def ways_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """One setting of the errors; percent, and below the first row differences to it, with their intervals."""
    first = rows[0]
    title = f"{first['rate']:.0%} of reads err, {_kind(first)}: the agent, and other ways less the agent"
    cells = [
        (row["way"], *(_cell(name, (row["difference"] or row)[name], bool(row["difference"])) for name in MEASURES))
        for row in rows
    ]
    return make_table(title, ("way", *MEASURES), cells)


def _kind(row: Mapping[str, Any]) -> str:
    return f"correlation {row['shared']:g}, {'honest' if row['honest'] else 'overconfident'}"


def _cell(name: str, values: Sequence[float], signed: bool) -> str:
    scale = 1 if name in ("calls", "images") else 100
    return estimate([scale * value for value in values], "+.1f" if signed else ".1f")


def audit_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    measures = ("calls", "images", "mended", "spoiled", "hacks", "false_hacks")
    cells = [(_kind(row), row["audit"], *(_cell(name, row[name], True) for name in measures)) for row in rows]
    return make_table("per audited clip, percent of clips", ("errors", "audit", *measures), cells)
