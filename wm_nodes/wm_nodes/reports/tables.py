"""The result of a run as a table: before and after, imagined and real, always together."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from rich.table import Table

from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.summary import SuccessRate, Summary


@dataclass(frozen=True)
class Cell:
    """One rate as texts."""

    count: str
    """E.g. "123 / 200"."""
    percent: str
    """E.g. "61.5 %"."""
    interval: str
    """E.g. "95 %: 54.6 to 68.0 %"."""


class ResultRow(NamedTuple):
    """A line of the table of results."""

    label: str
    """What was measured."""
    real: Cell
    """In the simulator."""
    imagined: Cell
    """In the world model."""


def result_rows(summary: Summary) -> list[ResultRow]:
    """Before, after, and the difference on the same seeds."""
    return [
        ResultRow("before (SFT policy)", _rate(summary.real_before), _rate(summary.imagined_before)),
        ResultRow("after (RL in the world model)", _rate(summary.real_after), _rate(summary.imagined_after)),
        ResultRow(
            "difference",
            _difference(summary.real_before, summary.real_after, summary.paired),
            _difference(summary.imagined_before, summary.imagined_after, summary.imagined_paired),
        ),
    ]


def verdict(summary: Summary) -> str:
    """One sentence: whether the real difference is above what chance explains."""
    if summary.real_after is None:
        return ("Nothing real was measured (evaluation.environment is none): what is imagined does not say whether the "
                "policy got better.")
    if "low" not in summary.paired:
        return "The real difference was not measured on paired seeds."
    points, low, high = (100 * float(summary.paired[name]) for name in ("difference", "low", "high"))
    effect = f"{points:+.1f} points in the real simulator (95 % interval {low:+.1f} to {high:+.1f})"
    if low > 0:
        return f"The policy got better: {effect}."
    if high < 0:
        return f"The policy got worse: {effect}."
    return f"No difference that chance does not explain: {effect}."


def results_table(summary: Summary) -> Table:
    """The table for the terminal."""
    title = f"{summary.task}, preset {summary.preset}, seed {summary.seed}, reward {summary.reward}"
    table = make_table(title, ("success", "real simulator", "imagined"), caption=verdict(summary))
    for label, *cells in result_rows(summary):
        texts = (f"{cell.percent}   {cell.count}\n[dim]{cell.interval}" for cell in cells)
        table.add_row(label, *texts, style="bold" if label == "difference" else "", end_section=True)
    return table


ROUND_COLUMNS = ("round", "updates", "imagined before", "imagined after", "real after", "refreshed model")


def round_rows(summary: Summary) -> list[tuple[str, ...]]:
    """One row of texts for each online round, under ROUND_COLUMNS."""
    rows = []
    for entry in summary.rounds:
        verdict = entry["verdict"]
        words = "" if not verdict else f"{'taken' if verdict['accepted'] else 'old one kept'}: {verdict['reason']}"
        rates = (_share(entry[name]) for name in ("imagined_before", "imagined", "real"))
        rows.append((str(entry["number"]), str(entry["updates"]), *rates, words))
    return rows


def rounds_table(summary: Summary) -> Table:
    """The online rounds for the terminal."""
    title = "online rounds: success in the model of the round, and in the simulator"
    return make_table(title, ROUND_COLUMNS, round_rows(summary), left=ROUND_COLUMNS[-1:])


TASK_COLUMNS = ("task", "before", "after", "difference, points (95 %)")


def task_rows(summary: Summary) -> list[tuple[str, ...]]:
    """One row of texts for the real success of each task, under TASK_COLUMNS."""
    rows = []
    for task, found in summary.by_task.items():
        rates = (f"{found[f'successes_{when}']} / {found['episodes']}" for when in ("before", "after"))
        points, low, high = (100 * found[name] for name in ("difference", "low", "high"))
        rows.append((task, *rates, f"{points:+.1f} ({low:+.1f} to {high:+.1f})"))
    return rows


def tasks_table(summary: Summary) -> Table:
    """The real success of each task for the terminal."""
    return make_table("real success by task", TASK_COLUMNS, task_rows(summary))


EXPLOIT_COLUMNS = ("updates", "imagined", "replayed", "real", "precision (95 %)", "recall (95 %)")


def exploit_rows(summary: Summary) -> list[tuple[str, ...]]:
    """One row of texts for each reading of the exploit meter, under EXPLOIT_COLUMNS."""
    return [
        (
            str(reading["step"]), *(f"{100 * reading[f'{name}_success']:.1f} %" for name in EXPLOIT_COLUMNS[1:4]),
            *(_interval(reading, name) for name in ("precision", "recall")),
        )
        for reading in summary.exploit_meter
    ]


def exploit_title(summary: Summary) -> str:
    return f"exploit meter: success of {summary.exploit_meter[-1]['episodes']:.0f} episodes of the policy"


def exploit_table(summary: Summary) -> Table:
    """The exploit meter's readings for the terminal."""
    caption = " ".join(f"Training ended early: {reason}." for reason in summary.stopped)
    return make_table(exploit_title(summary), EXPLOIT_COLUMNS, exploit_rows(summary), caption=caption)


def _interval(reading: Mapping[str, Any], name: str) -> str:
    if reading[name] is None:
        return "undefined"
    share, low, high = (100 * reading[f"{name}{end}"] for end in ("", "_low", "_high"))
    return f"{share:.1f} % ({low:.1f} to {high:.1f})"


def _share(rate: Mapping[str, Any]) -> str:
    return f"{100 * rate['rate']:.1f} % ({rate['successes']}/{rate['episodes']})"


def _rate(rate: SuccessRate | None) -> Cell:
    if rate is None:
        return Cell("", "not measured", "")
    return Cell(
        f"{rate.successes} / {rate.episodes}", f"{100 * rate.rate:.1f} %",
        f"95 %: {100 * rate.low:.1f} to {100 * rate.high:.1f} %",
    )


def _difference(before: SuccessRate | None, after: SuccessRate | None, paired: Mapping[str, Any]) -> Cell:
    if before is None or after is None:
        return _rate(None)
    points = f"{100 * (after.rate - before.rate):+.1f} points"
    if "low" not in paired or not math.isfinite(float(paired["low"])):
        return Cell("", points, "not paired")
    count = f"{paired['gained']} gained, {paired['lost']} lost" if "gained" in paired else ""
    return Cell(
        count, f"{100 * float(paired['difference']):+.1f} points",
        f"95 %: {100 * float(paired['low']):+.1f} to {100 * float(paired['high']):+.1f}",
    )
