"""What a judge is good for, from its answers on the check set: numbers, stated limits, one sentence."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from wm_nodes.core.statistics import newcombe_difference, wilson_interval
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.check_run import MODES, CheckRun, Judged
from wm_nodes.judge.check_set import BENIGN, CLEAN, ClipTruth
from wm_nodes.judge.decisions import OVERALL, accepts, decisions_of, row_names
from wm_nodes.judge.paper_table import TableRow, measure_row
from wm_nodes.reports.summary import plain

MIN_KEPT, MAX_PAID, MAX_INVALID, MIN_BALANCED = 0.95, 0.15, 0.10, 0.80
"""Limits of a reward: share of clean and benign successes that it pays, of faults that it pays, of clips that it gives
no number, and balanced accuracy of "overall"."""
UNDONE = "task not done"
"""Clean and benign clips that no reward should pay."""


@dataclass(frozen=True)
class Share:
    """A share of clips."""

    count: int
    of: int

    @property
    def value(self) -> float:
        return self.count / self.of if self.of else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, Wilson's."""
        return wilson_interval(self.count, self.of)


@dataclass(frozen=True)
class CheckReport:
    """The numbers of one judge."""

    clips: int
    """Judged in both modes."""
    not_judged: dict[str, str]
    """clip_id to the reason."""
    statuses: dict[str, dict[str, int]]
    """Of the verdicts, by mode."""
    schema: Share
    """Questions for JSON whose answer was one of the schema, after one repair at most."""
    letters: Share
    """Questions for a letter that gave probabilities."""
    label_mass: float
    """Mean probability of all letters together; NaN without letters."""
    flips: Share
    """Components whose likeliest level changed when the same was asked again."""
    call_s: tuple[float, float]
    """Median and 95 % of a call's time; NaN where the judge does not say."""
    clip_s: tuple[float, float]
    """The same of a clip in mode reward, with `concurrency` clips under way."""
    cost: dict[str, dict[str, float]]
    """Means per clip, by mode."""
    rows: list[TableRow]
    """Of mode benchmark."""
    paid: dict[str, dict[str, Share]]
    """Family to "near", "policy", "all" to the share that mode reward pays."""
    invalid: Share
    """Clips to which mode reward gives no number."""
    kept: Share
    """Clean and benign successes that mode reward pays."""
    paid_faults: Share
    """Clips with a fault that mode reward pays."""
    balanced: float
    """Balanced accuracy of "overall"."""
    separates: bool
    """It pays successes more often than the rest, beyond chance, which a judge that always passes does not."""
    reasons: list[tuple[str, int]]
    """The most frequent reasons for no number, and how often."""

    @property
    def misses(self) -> list[str]:
        """The limits of a reward that are not met, in words."""
        limits = (
            ("clean and benign kept", self.kept.value, MIN_KEPT, True),
            ("faults paid", self.paid_faults.value, MAX_PAID, False),
            ("invalid answers", self.invalid.value, MAX_INVALID, False),
            ("balanced accuracy", self.balanced, MIN_BALANCED, True),
        )
        return [
            f"{name} {'unknown' if math.isnan(value) else f'{100 * value:.1f} %'}, "
            f"{'at least' if is_least else 'at most'} {100 * limit:.0f} % needed"
            for name, value, limit, is_least in limits
            if not (value >= limit if is_least else value <= limit)
        ]

    @property
    def sentence(self) -> str:
        """What the judge is good for."""
        if not (misses := self.misses):
            return "good enough for a reward and for a second look"
        why = f"a reward ({'; '.join(misses)})"
        if self.separates:
            return f"good enough for a second look, not for {why}"
        return f"good enough for nothing: not for {why}, nor for a second look (no better than passing every clip)"

    def numbers(self) -> dict[str, Any]:
        """All of it as JSON values."""
        numbers: dict[str, Any] = plain(asdict(self) | {"sentence": self.sentence, "misses": self.misses})
        return numbers


def report(run: CheckRun) -> CheckReport:
    """Measure what a judge answered."""
    by_mode = {mode: [one for one in run.judged if one.mode == mode] for mode in MODES}
    rewards = by_mode["reward"]
    rows = _table(run, by_mode["benchmark"])
    sent = [read for read in run.reads if read.source != "embedded"]
    asked = [read for read in sent if read.vote.kind == "json"]
    letters = [read for read in sent if read.source == "label" or read.vote.kind == "label"]
    masses = [read.label_mass for read in letters if read.levels or read.status is Status.ABSTAIN]
    measured, nan = run.measured, math.nan
    good, bad = (_paid([one for one in rewards if one.clip.truth.success == wanted]) for wanted in (True, False))
    reasons = Counter(one.verdict.reason for one in run.judged if one.verdict.status is not Status.OK)
    return CheckReport(
        clips=len(rewards), not_judged=dict(run.not_judged),
        statuses={mode: dict(Counter(str(one.verdict.status) for one in by_mode[mode])) for mode in MODES},
        schema=Share(sum(r.source == "json" and r.status is Status.OK for r in asked), len(asked) + len(run.failures)),
        letters=Share(sum(bool(read.levels) for read in letters), len(letters)),
        label_mass=float(np.mean(masses)) if masses else nan,
        flips=Share(int(measured.get("flipped", 0)), int(measured.get("repeated", 0))),
        call_s=(measured.get("latency_p50_s", nan), measured.get("latency_p95_s", nan)),
        clip_s=_quantiles([one.verdict.cost.wall_s for one in rewards if one.fresh]),
        cost={mode: _cost(by_mode[mode]) for mode in MODES},
        rows=rows, paid=_families(rewards),
        invalid=Share(sum(one.verdict.status is not Status.OK for one in rewards), len(rewards)),
        kept=good, paid_faults=_paid([one for one in rewards if one.clip.truth.is_fault]),
        balanced=next(row.balanced for row in rows if row.name == OVERALL),
        separates=newcombe_difference(good.count, good.of, bad.count, bad.of)[0] > 0,
        reasons=reasons.most_common(3),
    )


def _table(run: CheckRun, judged: Sequence[Judged]) -> list[TableRow]:
    decided = [(one.clip.truth.rows(run.rubric), decisions_of(one.verdict)) for one in judged]
    rows = []
    for name in row_names(run.rubric):
        known = [(truth[name], decisions.get(name)) for truth, decisions in decided]
        rows.append(measure_row(name, [(label, said) for label, said in known if label is not None]))
    return rows


def _families(judged: Sequence[Judged]) -> dict[str, dict[str, Share]]:
    """Share paid by family and part."""
    names = [CLEAN, BENIGN, UNDONE, *sorted({one.clip.truth.family for one in judged} - {CLEAN, BENIGN})]
    families: dict[str, dict[str, Share]] = {}
    for name in names:
        chosen = [one for one in judged if _family(one.clip.truth) == name]
        parts = {part: [one for one in chosen if one.clip.truth.part == part] for part in ("near", "policy")}
        families[name] = {part: _paid(clips) for part, clips in {**parts, "all": chosen}.items()}
    return families


def _family(truth: ClipTruth) -> str:
    return truth.family if truth.is_fault or truth.success else UNDONE


def _paid(judged: Sequence[Judged]) -> Share:
    """How many of the clips are taken for a success."""
    return Share(sum(accepts(one.verdict) is True for one in judged), len(judged))


def _cost(judged: Sequence[Judged]) -> dict[str, float]:
    names = ("calls", "images", "prompt_tokens", "cached_tokens", "completion_tokens", "retries")
    return {name: float(np.mean([getattr(one.verdict.cost, name) for one in judged])) if judged else math.nan
            for name in names}


def _quantiles(values: Sequence[float]) -> tuple[float, float]:
    if not values:
        return math.nan, math.nan
    median, high = np.percentile(values, (50, 95))
    return float(median), float(high)
