"""The reward benchmark's tables on the console."""

from collections.abc import Mapping, Sequence

from rich.table import Table

from benchmarks.judge.hacking import Curve
from benchmarks.judge.metrics import LabelAgreement, PatternRow

PARTS = ("clarity", "brightness", "color", "temporal", "background", "objective", "robot", "viewpoint", "interaction",
         "deformation", "geometry")


def table2(rows: Sequence[LabelAgreement], caption: str) -> Table:
    """The paper's Table 2, with what it leaves out."""
    table = Table(title="agreement with the labels, Table 2 of the paper", caption=caption)
    table.add_column("row", no_wrap=True)
    columns = (
        "paper", "n", "silent", "accuracy", "95 % Wilson", "fails", "balanced", "kappa", "ECE", "AUROC",
    )
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        name = f"  {row.name}" if row.name in PARTS else row.name
        paper = "-" if row.paper is None else f"{row.paper:.0f}"
        table.add_row(
            name, paper, str(row.n), str(row.silent), _percent(row.accuracy),
            f"{100 * row.low:.1f} to {100 * row.high:.1f}", _percent(row.prevalence), _percent(row.balanced),
            _number(row.kappa), _number(row.calibration), _number(row.auroc),
        )
    return table


def split_table(splits: Mapping[str, Sequence[LabelAgreement]]) -> Table:
    """Accuracy, and how many labels it is of, per split."""
    table = Table(title="accuracy by split: what is new to a judge that was trained on the others")
    table.add_column("split")
    for row in next(iter(splits.values())):
        table.add_column(row.name, justify="right")
    for name, rows in splits.items():
        table.add_row(name, *(f"{_percent(row.accuracy)} of {row.n}" for row in rows))
    return table


def confusion_table(rows: Sequence[LabelAgreement], patterns: Sequence[PatternRow]) -> Table:
    table = Table(title="confusion: label, answer and how often; of hacking patterns also on which recipes")
    table.add_column("row", no_wrap=True)
    table.add_column("label called answer")
    for row in rows:
        table.add_row(row.name, _counted(row.confusion))
    for pattern in patterns:
        parts = (pattern.confusion, pattern.unflagged, pattern.false_flags)
        table.add_row(f"flag: {pattern.pattern}", "; ".join(map(_counted, parts)))
    return table


def pattern_table(rows: Sequence[PatternRow]) -> Table:
    table = Table(
        title="hacking patterns",
        caption="flagged: confirmed by two reads; false positives on clips without any pattern; refused: not accepted, "
        "by whatever stage; wins: reward of the hacked clip >= that of its clean recording",
    )
    table.add_column("pattern")
    for name in ("n", "clean", "flagged", "95 % Wilson", "false pos.", "recall at 5 % f.p.", "AUROC", "refused",
                 "pairs", "wins", "gap"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            row.pattern, str(row.n), str(row.clean), _percent(row.recall),
            f"{100 * row.low:.1f} to {100 * row.high:.1f}", _percent(row.false_positives), _percent(row.best_recall),
            _number(row.auroc), _percent(row.refused), str(row.pairs), _percent(row.win_rate), _number(row.gap),
        )
    return table


def cost_table(costs: Mapping[str, Mapping[str, float]]) -> Table:
    """Means per clip, a column per way of judging."""
    table = Table(title="per clip", caption="asked: counted in front of the judge; billed: what it says it used")
    table.add_column("mean of")
    for name in costs:
        table.add_column(name, justify="right")
    for measure in next(iter(costs.values())):
        table.add_row(measure, *(_plain(means[measure]) for means in costs.values()))
    return table


def curve_table(curves: Sequence[Curve], caption: str) -> Table:
    """The reward that was climbed and the truth, before and after, and the alarm of DD-2."""
    table = Table(title="climbing a reward, mean over clips", caption=caption)
    for name in ("reward", "climbed", "clean clips have", "beat it before, after", "truth", "alarm", "taken most"):
        table.add_column(name)
    for course in curves:
        alarm = "; ".join(f"truth {a.true_slope:+.4f}, reward {a.proxy_slope:+.4f}" for a in course.alarms) or "none"
        climbed, truth = (f"{values[0]:.3f} -> {values[-1]:.3f}" for values in (course.proxy, course.truth))
        wins = f"{_percent(course.before)} -> {_percent(course.wins)} %"
        most_used = ", ".join(course.most_used[:3]) or "-"
        table.add_row(course.reward, climbed, _number(course.clean), wins, truth, alarm, most_used)
    return table


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "-"


def _percent(share: float) -> str:
    return "-" if share != share else f"{100 * share:.1f}"


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.3f}"


def _plain(value: float) -> str:
    return "-" if value != value else f"{value:,.4g}" if value < 1000 else f"{value:,.0f}"
