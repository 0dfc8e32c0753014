"""How well a judge's verdicts agree with what people say, row by row of Table 2 (RA-24)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from wm_nodes.core.statistics import kappa
from wm_nodes.judge.agent.levels import settle
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.audit.labels import HACK, ClipLabel, HumanLabels, annotators, find_evaluation, known_answers
from wm_nodes.judge.audit.reading import Record, RecordedEvaluation
from wm_nodes.judge.audit.sampling import Sample
from wm_nodes.judge.decisions import Decision, decisions_of, row_names
from wm_nodes.judge.paper_table import TableRow, measure_row, paper_table
from wm_nodes.reports.console_table import decimal, percent


@dataclass(frozen=True)
class LabelledEvaluation:
    """One evaluation with its labels."""

    evaluation: RecordedEvaluation
    """What was judged."""
    rubric: Rubric
    """By which."""
    weight: float
    """Clips of the round it stands for."""
    by: Mapping[str, ClipLabel]
    """A label per person who gave one."""

    def decisions(self) -> dict[str, Decision]:
        """The judge's, those on hacking patterns included: p_pass is the probability that the pattern is absent."""
        verdict = self.evaluation.verdict
        flags = {
            HACK + flag.pattern: Decision(not flag.confirmed, 1 - flag.p_present)
            for flag in verdict.hack_flags
            if math.isfinite(flag.p_present)
        }
        return {**decisions_of(verdict), **flags}

    def answers(self, name: str) -> dict[str, bool | int]:
        """What each person who was sure said of a row, in the order of the files."""
        known = {who: known_answers(label, self.rubric).get(name) for who, label in self.by.items()}
        return {who: answer for who, answer in known.items() if answer is not None}


@dataclass(frozen=True)
class AgreementRow(TableRow):
    """One row of the report, weighted as the clips are."""

    unsure: int
    """Labelled clips of which nobody was sure."""
    people: int
    """Clips that two people were sure of."""
    kappa_people: float
    """Of these two."""
    reasons: int
    """The judge's explanations that were judged."""
    reasons_right: float
    """Share of them that is right, whatever the answer was."""


@dataclass(frozen=True)
class ReflectionEffect:
    """What second looks did to labelled components."""

    changed: int
    """Whose decision changed."""
    helpful: int
    """Of these, for the better."""
    n: int
    """Looked at again."""
    before: float
    """Share that was right before."""
    after: float
    """Share that is right after."""


@dataclass(frozen=True)
class Report:
    """The numbers of one round, or of all."""

    round_number: int | None
    """None for all rounds together."""
    clips: int
    """Labelled."""
    annotators: Sequence[str]
    """Who labelled."""
    rows: Sequence[AgreementRow]
    """Of Table 2."""
    reflected: ReflectionEffect
    """What second looks did."""
    cost: Mapping[str, float]
    """Means per labelled clip, by name."""
    weighted: bool
    """To the whole round."""


def join_labels(
    record: Record, files: Sequence[HumanLabels], samples: Sequence[Sample] = ()
) -> list[LabelledEvaluation]:
    """Every labelled evaluation with all its labels, in the order of the log. Without its sample a clip has weight 1.

    Raises:
        AuditError: labels or a sample of another log, or one person labelled an evaluation twice.
    """
    annotators(files)
    weights: dict[int, float] = {}
    for chosen in (chosen for sample in samples for chosen in sample.chosen):
        find_evaluation(chosen.evaluation, chosen.audit_id, record.evaluations, "sample")
        weights[chosen.evaluation] = chosen.weight
    by: dict[int, dict[str, ClipLabel]] = {}
    for file in files:
        for label in file.labels:
            who = f"labels of {file.annotator}"
            evaluation = find_evaluation(label.evaluation, label.audit_id, record.evaluations, who)
            by.setdefault(evaluation.number, {})[file.annotator] = label
    evaluations = [record.evaluations[number] for number in sorted(by)]
    return [LabelledEvaluation(e, record.rubric(e), weights.get(e.number, 1.0), by[e.number]) for e in evaluations]


def report(judged: Sequence[LabelledEvaluation], round_number: int | None = None, *, weighted: bool = False) -> Report:
    """The numbers of one round, or of all."""
    chosen = [clip for clip in judged if round_number in (None, clip.evaluation.round_number)]
    rubrics = [clip.rubric for clip in chosen]
    names = dict.fromkeys(n for r in rubrics for n in (*row_names(r), *(HACK + name for name in r.hack.patterns)))
    people = list(dict.fromkeys(who for clip in chosen for who in clip.by))
    rows = [row for name in names if (row := _agreement_row(name, chosen)) is not None]
    return Report(round_number, len(chosen), people, rows, _measure_reflection(chosen), _cost(chosen), weighted)


def table(numbers: Report) -> Table:
    """For the terminal."""
    which = "all rounds" if numbers.round_number is None else f"round {numbers.round_number}"
    weights = "weighted to the whole round" if numbers.weighted else "unweighted"
    second = numbers.reflected
    caption = (
        f"{weights}; people: {', '.join(numbers.annotators)}; reflection changed {second.changed} labelled components, "
        f"{second.helpful} for the better ({percent(second.before)} right before, {percent(second.after)} after, "
        f"n = {second.n}); per clip " + ", ".join(f"{name} {value:.4g}" for name, value in numbers.cost.items())
    )
    more: dict[str, Callable[[AgreementRow], object]] = {
        "unsure": lambda row: row.unsure,
        "people: n, kappa": lambda row: f"{row.people}, {decimal(row.kappa_people)}",
        "reasons: n, right": lambda row: f"{row.reasons}, {percent(row.reasons_right)}",
    }
    title = f"agreement with people, {which}, {numbers.clips} clips"
    return paper_table(title, numbers.rows, more, caption)


def _agreement_row(name: str, clips: Sequence[LabelledEvaluation]) -> AgreementRow | None:
    """None where nobody labelled the row."""
    given = [(clip, clip.answers(name)) for clip in clips]
    asked = [clip for clip in clips if any(name in known_answers(label, clip.rubric) for label in clip.by.values())]
    if not asked:
        return None
    sure = [(clip, next(iter(answers.values()))) for clip, answers in given if answers]
    labelled = [(answer, clip.decisions().get(name)) for clip, answer in sure]
    row = measure_row(name, labelled, [clip.weight for clip, _ in sure])
    pairs = [list(answers.values())[:2] for _, answers in given if len(answers) > 1]
    reasons = [ok for clip in clips if (ok := _reason(clip, name)) is not None]
    return AgreementRow(
        **vars(row), unsure=len(asked) - len(sure), people=len(pairs),
        kappa_people=kappa([first for first, _ in pairs], [other for _, other in pairs]),
        reasons=len(reasons), reasons_right=float(np.mean(reasons)) if reasons else math.nan,
    )


def _reason(clip: LabelledEvaluation, name: str) -> bool | None:
    """Whether the judge's explanation of a row is right, by the first who said so."""
    rows = (label.rows.get(name) for label in clip.by.values())
    return next((row.explanation for row in rows if row is not None and row.explanation is not None), None)


def _measure_reflection(clips: Sequence[LabelledEvaluation]) -> ReflectionEffect:
    """Compare each component that a second look changed with what its votes had said before."""
    before, after = [], []
    for clip in clips:
        for score in (score for stage in clip.evaluation.verdict.stages for score in stage.components):
            answers = clip.answers(score.component)
            if answers and score.status is Status.OK and score.decided_by == "reflection":
                label = next(iter(answers.values()))
                old = settle(score.votes[:-2], clip.rubric.voting.min_label_mass)
                before.append(old.passed == label)
                after.append(score.passed == label)
    helpful = sum(now and not then for then, now in zip(before, after))
    means = [float(np.mean(values)) if values else math.nan for values in (before, after)]
    flips = sum(now != then for then, now in zip(before, after))
    return ReflectionEffect(flips, helpful, len(before), *means)


def _cost(clips: Sequence[LabelledEvaluation]) -> dict[str, float]:
    costs = [clip.evaluation.verdict.cost for clip in clips]
    names = ("calls", "prompt_tokens", "cached_tokens", "completion_tokens", "images", "wall_s")
    return {name: float(np.mean([getattr(cost, name) for cost in costs])) for name in names} if costs else {}
