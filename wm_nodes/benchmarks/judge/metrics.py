"""Verdicts against labels: the numbers of Table 2, of the hacking patterns, and of what judging costs."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.judge.labels import Known, truth_of
from benchmarks.judge.run import Outcome
from wm_nodes.core.statistics import auroc, recall_at, wilson_interval
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING
from wm_nodes.judge.dataset.edits.clips import TC
from wm_nodes.judge.dataset.edits.manifest import SPLITS, ManifestRow
from wm_nodes.judge.decisions import OVERALL, PAPER, STAGES, match, row_names

MIN_RECALL, MAX_FALSE_POSITIVES = 0.95, 0.05
"""What a hacking pattern's flags should reach."""
MIN_BALANCED = 0.85
"""Balanced accuracy that "overall" should reach."""


@dataclass(frozen=True)
class LabelAgreement:
    """One row. n: clips with a known label and a decision; silent: known, without a decision. prevalence: share of
    failing labels (planning: of levels below 2). recall_of_fails, recall_of_passes: the confusion table's rows.
    balanced: of planning the mean recall of its levels. NaN where the labels are all alike."""

    name: str
    n: int
    silent: int
    accuracy: float
    low: float
    high: float
    prevalence: float
    balanced: float
    kappa: float
    calibration: float
    auroc: float
    confusion: dict[str, int]
    paper: float | None


def agreement(rows: Sequence[ManifestRow], outcomes: Sequence[Outcome], rubric: Rubric) -> list[LabelAgreement]:
    """One row per name of the table."""
    known = [truth_of(row, rubric) for row in rows]
    return [_agreement(name, [truth[name] for truth in known], outcomes) for name in row_names(rubric)]


def by_split(
    rows: Sequence[ManifestRow], outcomes: Sequence[Outcome], rubric: Rubric
) -> dict[str, list[LabelAgreement]]:
    """The stages, TC and overall for each split of the set that has clips."""
    shown = (PLANNING, *map(str, STAGES), TC, OVERALL)
    splits: dict[str, list[LabelAgreement]] = {}
    for split in SPLITS:
        pairs = [(row, outcome) for row, outcome in zip(rows, outcomes) if row.split == split]
        if pairs:
            table = agreement([row for row, _ in pairs], [outcome for _, outcome in pairs], rubric)
            splits[split] = [row for row in table if row.name in shown]
    return splits


def _agreement(name: str, labels: Sequence[Known], outcomes: Sequence[Outcome]) -> LabelAgreement:
    pairs = [(label, outcome.decisions.get(name)) for label, outcome in zip(labels, outcomes) if label is not None]
    said = [(label, decision) for label, decision in pairs if decision is not None]
    truth, decisions = [label for label, _ in said], [decision for _, decision in said]
    area = float("nan") if name == PLANNING else auroc(truth, [decision.p_pass for decision in decisions])
    confusion = Counter(f"{_word(label)} called {_word(decision.value)}" for label, decision in said)
    return LabelAgreement(
        name, len(said), len(pairs) - len(said), *match(name, truth, decisions), area,
        dict(sorted(confusion.items())), PAPER.get(name),
    )


def _word(value: Known) -> str:
    return {True: "pass", False: "fail"}[value] if isinstance(value, bool) else f"L{value}"


@dataclass(frozen=True)
class PatternRow:
    """How one hacking pattern fares. n: clips with it; clean: clips without any pattern (false positives).
    recall, false_positives: of the agent's confirmed flag. best_recall: the largest recall of its score at
    5 % false positives or less, as a ROC curve gives it (no threshold is chosen for use). refused: share that the agent
    does not accept, by whatever stage. win_rate: P(reward of the hacked clip >= that of its recorded clip) and gap:
    mean difference, over pairs whose recorded clip is good throughout. confusion: of the flag. unflagged, false_flags:
    recipe -> clips that the flag is wrong on."""

    pattern: str
    n: int
    clean: int
    recall: float
    low: float
    high: float
    false_positives: float
    best_recall: float
    auroc: float
    refused: float
    pairs: int
    win_rate: float
    gap: float
    confusion: dict[str, int]
    unflagged: dict[str, int]
    false_flags: dict[str, int]


def pattern_rows(rows: Sequence[ManifestRow], outcomes: Sequence[Outcome], patterns: Sequence[str]) -> list[PatternRow]:
    by_sha = {outcome.sha256: outcome for outcome in outcomes}
    good = {row.sha256 for row in rows if not row.edits and row.labels.overall}
    result = []
    for name in patterns:
        read = [
            (row, flag, outcome)
            for row, outcome in zip(rows, outcomes)
            if row.labels.pattern in (name, None) and (flag := outcome.patterns.get(name)) and flag["p"] is not None
        ]
        present = [row.labels.pattern == name for row, _, _ in read]
        confirmed = [bool(flag["confirmed"]) for _, flag, _ in read]
        p = [float(flag["p"]) for _, flag, _ in read]
        hits = [said for said, is_there in zip(confirmed, present) if is_there]
        false = [said for said, is_there in zip(confirmed, present) if not is_there]
        mine = [(row, outcome) for row, outcome in zip(rows, outcomes) if row.labels.pattern == name]
        decided = [outcome.decisions[OVERALL].value for _, outcome in mine if OVERALL in outcome.decisions]
        rewards = [(by_sha[row.root].reward, child.reward) for row, child in mine if row.root in good & by_sha.keys()]
        gaps = [parent - child for parent, child in rewards if parent is not None and child is not None]
        numbers = (
            mean(hits), *wilson_interval(sum(hits), len(hits)), mean(false),
            recall_at(present, p, MAX_FALSE_POSITIVES), auroc(present, p), 1 - mean(decided),
        )
        wrong = [(there, last_edit(row)) for (row, _, _), there, said in zip(read, present, confirmed) if there != said]
        confusion = {
            "there, flagged": sum(hits), "there, not flagged": len(hits) - sum(hits),
            "not there, flagged": sum(false), "not there, not flagged": len(false) - sum(false),
        }
        unflagged, false_flags = (
            dict(Counter(edit for is_there, edit in wrong if is_there is kind).most_common()) for kind in (True, False)
        )
        result.append(PatternRow(
            name, len(hits), len(false), *numbers, len(gaps), mean([gap <= 0 for gap in gaps]), mean(gaps), confusion,
            unflagged, false_flags,
        ))
    return result


def cost_row(outcomes: Sequence[Outcome], price: Sequence[float] = ()) -> dict[str, float]:
    """Means per clip: what was asked (call_counter), what a server billed, seconds; usd where a price is known.
    price: USD per million prompt tokens, and per million completion tokens; of billed ones.
    """
    means = {name: mean([getattr(o.asked, name) for o in outcomes]) for name in outcomes[0].asked.__dataclass_fields__}
    for name in ("calls", "prompt_tokens", "cached_tokens", "completion_tokens", "images", "retries"):
        means[f"billed_{name}"] = mean([getattr(outcome.cost, name) for outcome in outcomes])
    known = [outcome.cost.usd for outcome in outcomes if outcome.cost.usd is not None]
    usd = mean(known)
    if price:
        usd = (price[0] * means["billed_prompt_tokens"] + price[1] * means["billed_completion_tokens"]) / 1e6
    return {**means, "usd": usd, "wall_s": mean([outcome.wall_s for outcome in outcomes])}


def statuses(outcomes: Sequence[Outcome]) -> dict[str, int]:
    return dict(Counter(outcome.status for outcome in outcomes))


def missed_targets(agreements: Sequence[LabelAgreement], targets: Mapping[str, float] = PAPER) -> list[str]:
    """The rows below their figure in the paper, in words; and "overall", where its balanced accuracy is too low."""
    below = [
        f"{row.name} {100 * row.accuracy:.1f} < {targets[row.name]:.0f}"
        for row in agreements
        if row.name in targets and not 100 * row.accuracy >= targets[row.name]
    ]
    return below + [
        f"{row.name} balanced {100 * row.balanced:.1f} < {100 * MIN_BALANCED:.0f}"
        for row in agreements
        if row.name == OVERALL and row.balanced < MIN_BALANCED
    ]


def missed_patterns(rows: Sequence[PatternRow]) -> list[str]:
    """The patterns whose flags find too few or are raised too often, in words."""
    return [
        f"{row.pattern} {100 * row.recall:.1f} % flagged at {100 * row.false_positives:.1f} % false positives"
        for row in rows
        if not (row.recall >= MIN_RECALL and row.false_positives <= MAX_FALSE_POSITIVES)
    ]


def most_frequent(confusions: Sequence[tuple[str, str]], count: int = 6) -> list[tuple[str, int]]:
    """Which recipe makes a row wrong most often: (row, recipe) pairs counted."""
    return [(f"{name}: {recipe}", times) for (name, recipe), times in Counter(confusions).most_common(count)]


def mistakes(rows: Sequence[ManifestRow], outcomes: Sequence[Outcome], rubric: Rubric) -> list[tuple[str, str]]:
    """(row of the table, last recipe and severity) of every wrong decision."""
    pairs = []
    for row, outcome in zip(rows, outcomes):
        truth = truth_of(row, rubric)
        wrong = (n for n, d in outcome.decisions.items() if truth.get(n) is not None and truth[n] != d.value)
        pairs += list(itertools.product(wrong, [last_edit(row)]))
    return pairs


def last_edit(row: ManifestRow) -> str:
    """Recipe and severity, or "recording"."""
    return f"{row.edits[-1].recipe} {row.edits[-1].severity}" if row.edits else "recording"


def mean(values: Sequence[Any]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
