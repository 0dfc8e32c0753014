"""The reward benchmark's tables on the console."""

from collections.abc import Mapping, Sequence

from rich.table import Table

from benchmarks.judge.metrics import LabelAgreement, PatternRow
from wm_nodes.judge.dataset.edits.clips import COMPONENTS
from wm_nodes.reports.console_table import decimal, make_table, percent, percent_interval


def table2(rows: Sequence[LabelAgreement], caption: str) -> Table:
    """The paper's Table 2, with silent clips, intervals, prevalence and further measures of agreement."""
    columns = ("row", "paper", "n", "silent", "accuracy", "95 % Wilson", "fails", "balanced", "kappa", "ECE", "AUROC")
    cells = (
        (
            f"  {row.name}" if row.name in COMPONENTS else row.name, "-" if row.paper is None else f"{row.paper:.0f}",
            row.n, row.silent, percent(row.accuracy), percent_interval(row.low, row.high), percent(row.prevalence),
            percent(row.balanced), decimal(row.kappa), decimal(row.calibration), decimal(row.auroc),
        )
        for row in rows
    )
    title = "agreement with the labels, Table 2 of the paper"
    return make_table(title, columns, cells, caption=caption, no_wrap=columns)


def split_table(splits: Mapping[str, Sequence[LabelAgreement]]) -> Table:
    """Accuracy, and the number of labels behind it, per split."""
    columns = ("split", *(row.name for row in next(iter(splits.values()))))
    cells = ((name, *(f"{percent(row.accuracy)} of {row.n}" for row in rows)) for name, rows in splits.items())
    return make_table("accuracy by split: what is new to a judge that was trained on the others", columns, cells)


def confusion_table(rows: Sequence[LabelAgreement], patterns: Sequence[PatternRow]) -> Table:
    columns = ("row", "label called answer")
    cells = [(row.name, _counts(row.confusion)) for row in rows]
    for pattern in patterns:
        parts = (pattern.confusion, pattern.unflagged, pattern.false_flags)
        cells.append((f"flag: {pattern.pattern}", "; ".join(map(_counts, parts))))
    title = "confusion: label, answer and how often; of hacking patterns also on which recipes"
    return make_table(title, columns, cells, left=columns, no_wrap=("row",))


def pattern_table(rows: Sequence[PatternRow]) -> Table:
    columns = ("pattern", "n", "clean", "flagged", "95 % Wilson", "false pos.", "recall at 5 % f.p.", "AUROC",
               "refused", "pairs", "wins", "gap")
    cells = (
        (
            row.pattern, row.n, row.clean, percent(row.recall), percent_interval(row.low, row.high),
            percent(row.false_positives), percent(row.best_recall), decimal(row.auroc), percent(row.refused), row.pairs,
            percent(row.win_rate), decimal(row.gap),
        )
        for row in rows
    )
    caption = (
        "flagged: confirmed by two reads; false positives on clips without any pattern; refused: not accepted, by "
        "whatever stage; wins: reward of the hacked clip >= that of its clean recording"
    )
    return make_table("hacking patterns", columns, cells, caption=caption)


def cost_table(costs: Mapping[str, Mapping[str, float]]) -> Table:
    """Means per clip, a column per way of judging."""
    measures = next(iter(costs.values()))
    cells = ((measure, *(_amount(means[measure]) for means in costs.values())) for measure in measures)
    caption = "asked: counted in front of the judge; billed: what it says it used"
    return make_table("per clip", ("mean of", *costs), cells, caption=caption)


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "-"


def _amount(value: float) -> str:
    return "-" if value != value else f"{value:,.4g}" if value < 1000 else f"{value:,.0f}"
