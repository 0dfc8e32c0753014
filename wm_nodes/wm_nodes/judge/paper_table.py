"""The paper's Table 2 for a judge: how well its decisions agree with labels, row by row (RA-24)."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich.table import Table

from wm_nodes.core.statistics import balanced_accuracy, expected_calibration_error, kappa, wilson_of_share
from wm_nodes.judge.agent.types import PLANNING, TASK_COMPLETION
from wm_nodes.judge.decisions import OVERALL, Decision
from wm_nodes.reports.console_table import decimal, make_table, percent, percent_interval

PAPER: Mapping[str, float] = {
    PLANNING: 98.0, "VQ": 96.0, "clarity": 100.0, "brightness": 100.0, "color": 96.0, "temporal": 96.0, "IF": 90.0,
    "background": 95.0, "objective": 85.0, "robot": 88.0, "viewpoint": 100.0, "PC": 82.0, "interaction": 85.0,
    "deformation": 82.0, "geometry": 86.0, TASK_COMPLETION: 87.0, OVERALL: 91.0,
}
"""Table 2 of the paper, accuracy in percent on 100 clips."""
FAIR_LEVEL = 2
"""A planning label below this counts as a fail in the prevalence."""


@dataclass(frozen=True)
class TableRow:
    """One row; NaN where all labels are equal."""

    name: str
    """Of the row."""
    n: int
    """Labelled clips that the judge decided."""
    silent: int
    """Labelled clips that it did not decide."""
    accuracy: float
    """Weighted share of equal decisions."""
    low: float
    """95 % Wilson interval of the accuracy."""
    high: float
    """95 % Wilson interval of the accuracy."""
    prevalence: float
    """Weighted share of failing labels; of planning, of levels below 2."""
    balanced: float
    """Balanced accuracy; of planning, the mean recall of its levels."""
    kappa: float
    """Cohen's, of decisions and labels."""
    calibration: float
    """Expected calibration error of p_pass; of planning, of the chosen level."""
    paper: float | None
    """The paper's accuracy, percent."""


COLUMNS: Mapping[str, Callable[[Any], object]] = {
    "row": lambda row: row.name,
    "paper": lambda row: "-" if row.paper is None else f"{row.paper:.0f}",
    "n": lambda row: row.n,
    "silent": lambda row: row.silent,
    "accuracy": lambda row: percent(row.accuracy),
    "95 % Wilson": lambda row: percent_interval(row.low, row.high),
    "fails": lambda row: percent(row.prevalence),
    "balanced": lambda row: percent(row.balanced),
    "kappa": lambda row: decimal(row.kappa),
    "ECE": lambda row: decimal(row.calibration),
}


def measure_row(
    name: str, labelled: Sequence[tuple[bool | int, Decision | None]], weights: ArrayLike | None = None
) -> TableRow:
    """Measure one row. labelled: label and decision of each clip. weights: of each clip; kappa and level recall are
    unweighted.
    """
    said = [index for index, (_, decision) in enumerate(labelled) if decision is not None]
    weights = None if weights is None else np.asarray(weights)[said]
    pairs = [(label, decision) for label, decision in labelled if decision is not None]
    labels, values = [label for label, _ in pairs], [decision.value for _, decision in pairs]
    right, planning = [label == value for label, value in zip(labels, values)], name == PLANNING
    failing = [label < FAIR_LEVEL if planning else not label for label in labels]
    return TableRow(
        name, len(said), len(labelled) - len(said), *wilson_of_share(right, weights),
        wilson_of_share(failing, weights)[0],
        _level_recall(labels, right) if planning else balanced_accuracy(labels, values, weights), kappa(labels, values),
        expected_calibration_error(right if planning else labels, [decision.p_pass for _, decision in pairs], weights),
        PAPER.get(name),
    )


def paper_table(
    title: str, rows: Iterable[TableRow], more: Mapping[str, Callable[[Any], object]] | None = None,
    caption: str | None = None,
) -> Table:
    """The rows for the terminal. more: further columns, each with what it shows of a row."""
    columns = {**COLUMNS, **(more or {})}
    cells = ([cell(row) for cell in columns.values()] for row in rows)
    return make_table(title, tuple(columns), cells, caption=caption, no_wrap=("row", "95 % Wilson"))


def _level_recall(labels: Sequence[int], right: Sequence[bool]) -> float:
    recalls = [np.mean([ok for label, ok in zip(labels, right) if label == level]) for level in set(labels)]
    return float(np.mean(recalls)) if len(recalls) > 1 else float("nan")
