"""What acceptance says of a model: its criteria, and whether they let a policy be trained in it."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rich.table import Table

from wm_nodes.reports.console_table import make_table

Outcome = Literal["passed", "failed", "undecided"]
MARKS = {"passed": "[green]passed", "failed": "[red]failed[/]: {}", "undecided": "[yellow]too few episodes"}


@dataclass(frozen=True)
class Criterion:
    """One number of a world model, and whether it is good enough."""

    name: str
    """What is measured."""
    value: float
    """NaN where it could not be computed."""
    threshold: float | None
    """None where `rule` says everything."""
    rule: str
    """How value must compare with threshold."""
    outcome: Outcome
    """Of value against threshold, as `rule` says; undecided: there are too few episodes to pass or to fail the
    model."""
    remedy: str
    """What to do where it failed."""
    interval: tuple[float, float] | None = None
    """95 %, of the value; None where it is not known."""

    @property
    def passed(self) -> bool:
        return self.outcome == "passed"


@dataclass(frozen=True)
class AcceptanceReport:
    """Whether a world model may be trained in, criterion by criterion."""

    task: str
    """The task that it was judged for."""
    episodes: int
    """Held-out episodes, or parts of them; 0 where the frames were not judged."""
    criteria: tuple[Criterion, ...]
    """All that were judged."""
    metrics: dict[str, float]
    """Every number of the rollouts, by the names in docs/metrics.md and of pictures.picture_metrics."""
    notes: tuple[str, ...] = ()
    """What was measured and left out, and what could not be judged."""

    @property
    def outcome(self) -> Outcome:
        """failed: in any criterion; else undecided: in any, or there is none."""
        found = {criterion.outcome for criterion in self.criteria}
        return "failed" if "failed" in found else "undecided" if "undecided" in found or not found else "passed"

    @property
    def passed(self) -> bool:
        return self.outcome == "passed"

    @property
    def failed(self) -> tuple[str, ...]:
        return self._with("failed")

    @property
    def undecided(self) -> tuple[str, ...]:
        return self._with("undecided")

    def _with(self, outcome: Outcome) -> tuple[str, ...]:
        return tuple(criterion.name for criterion in self.criteria if criterion.outcome == outcome)

    @property
    def words(self) -> str:
        """The outcome and which criteria it is due to, in a line."""
        names = self.failed or self.undecided
        return " ".join([self.outcome, *([f"({', '.join(names)})"] if names else [])])

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, numbers that are not finite as None; with `outcome`, `passed`, `failed`,
        `undecided`."""
        values = asdict(self)
        values["criteria"] = [
            {**row, "value": _finite(row["value"]), "passed": row["outcome"] == "passed"} for row in values["criteria"]
        ]
        values["metrics"] = {name: _finite(value) for name, value in self.metrics.items()}
        return {
            **values, "outcome": self.outcome, "passed": self.passed, "failed": list(self.failed),
            "undecided": list(self.undecided),
        }

    def table(self) -> Table:
        """The criteria for the terminal; remedies where they failed."""
        words = self.outcome.upper() if self.failed else self.outcome
        rows = []
        for row in self.criteria:
            limit = "" if row.threshold is None else f" {row.threshold:g}"
            value = f"{row.value:.3f}" if math.isfinite(row.value) else "undefined"
            interval = "" if row.interval is None else f"{row.interval[0]:.2f} to {row.interval[1]:.2f}"
            rows.append((row.name, value, interval, row.rule + limit, MARKS[row.outcome].format(row.remedy)))
        title = f"acceptance {words}: {self.task}, {self.episodes} held-out real episodes"
        columns, caption = ("criterion", "value", "95 %", "must be", ""), "\n".join(self.notes) or None
        return make_table(title, columns, rows, left=("criterion", "must be", ""), caption=caption)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def number_of(value: float | None) -> float:
    """A number of a manifest, which has None for what is not finite."""
    return math.nan if value is None else float(value)


def at_step(metrics: Mapping[str, float | None], name: str, step: int) -> float:
    """The metric at a step; NaN where no episode was that long."""
    return number_of(metrics.get(f"{name}_h{step:02d}"))
