"""What planning, early exits and voting by need save, at which agreement: four ways of judging the same clips.

agent: reward mode. everything: the same without early exits. voted: every component voted on besides. exhaustive: that
on dense frames, which is what is left when all of the paper's measures of efficiency are taken away.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich.table import Table

from benchmarks.judge.metrics import cost_row
from benchmarks.judge.run import JudgeTrial, Outcome
from wm_nodes.core.statistics import PairedDifference, paired_difference
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import GATED, NUM_PLAN_LEVELS
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.decisions import OVERALL
from wm_nodes.reports.console_table import estimate, make_table, percent

ARMS = {
    "agent": "agent", "everything": "everything, no early exit", "voted": "every component voted",
    "exhaustive": "every component voted, dense frames",
}
VOTED = {"voting": {"levels": list(range(NUM_PLAN_LEVELS))}}
EXHAUSTIVE = {**VOTED, "stages": {str(stage): {"profile": "D"} for stage in GATED}}
MEASURES = ("reads", "calls", "images", "pixels", "tokens")


@dataclass(frozen=True)
class Savings:
    """The agent against another way, on the n clips that both decide. saved: share of the other's measures, by name.
    same: share of them with the same decision. accuracy, other_accuracy: of accepting, against the labels.
    difference: agent - other on the same clips, with Tango's interval."""

    against: str
    n: int
    saved: Mapping[str, float]
    same: float
    accuracy: float
    other_accuracy: float
    difference: PairedDifference


def trials(rubric: str, seed: int) -> list[JudgeTrial]:
    """The four ways, by one rubric pack."""
    plain, voted, exhaustive = (load_rubric(rubric, changed) for changed in ({}, VOTED, EXHAUSTIVE))
    return [
        JudgeTrial("agent", plain, "reward", seed), JudgeTrial("everything", plain, "benchmark", seed),
        JudgeTrial("voted", voted, "benchmark", seed), JudgeTrial("exhaustive", exhaustive, "benchmark", seed),
    ]


def measure_savings(rows: Sequence[ManifestRow], outcomes: Mapping[str, Sequence[Outcome]]) -> list[Savings]:
    """The agent against each of the others. Raises ValueError: no clip that both decide."""
    comparisons = []
    for name in list(ARMS)[1:]:
        decided = [
            (row, mine, other) for row, mine, other in zip(rows, outcomes["agent"], outcomes[name])
            if OVERALL in mine.decisions and OVERALL in other.decisions
        ]
        both = [(row.labels.overall, a.decisions[OVERALL].value, b.decisions[OVERALL].value) for row, a, b in decided]
        if not both:
            raise ValueError(f"no clip is decided by the agent and by {ARMS[name]}; see the statuses of the table")
        right, other_right = ([pair[k] == pair[0] for pair in both] for k in (1, 2))
        cost, other_cost = cost_row([mine for _, mine, _ in decided]), cost_row([other for _, _, other in decided])
        saved = {part: 1 - cost[part] / other_cost[part] for part in MEASURES}
        same = [mine == other for _, mine, other in both]
        agreed, mine_right, its_right = (sum(hits) / len(both) for hits in (same, right, other_right))
        paired = paired_difference(other_right, right)
        comparisons.append(Savings(ARMS[name], len(both), saved, agreed, mine_right, its_right, paired))
    return comparisons


def savings_table(rows: Sequence[Savings], caption: str) -> Table:
    columns = ("against", "n", *MEASURES, "same decision", "accuracy", "other's", "difference (95 %)")
    cells = []
    for row in rows:
        d = row.difference
        cells.append((
            row.against, row.n, *(f"-{percent(row.saved[part])} %" for part in MEASURES), percent(row.same),
            percent(row.accuracy), percent(row.other_accuracy),
            estimate((100 * d.difference, 100 * d.low, 100 * d.high), "+.1f"),
        ))
    return make_table("saved by the agent, and what it costs in agreement", columns, cells, caption=caption)
