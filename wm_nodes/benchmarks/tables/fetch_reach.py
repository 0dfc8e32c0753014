"""Rows of the tables of docs/results/fetch_reach.md; what they are about stands in pages.yaml."""

from collections.abc import Sequence

from benchmarks.tables.own_data import FILE
from benchmarks.tables.table import Rows, Run, lines, percent, points, points_over_seeds, read, share


def beside_control() -> Rows:
    """Runs of one model, beside PPO in the environment itself where that was made; then all seeds together."""
    made = [run for run in lines(FILE) if "control" in run]
    for run in made:
        yield _beside_control(run["run"], [run])
    for name in dict.fromkeys(run["run"].split(", seed")[0] for run in made):
        its = [run for run in made if run["run"].startswith(name)]
        if len(its) > 1:
            yield _beside_control(f"{name}, {len(its)} seeds", its)


def push_t() -> Rows:
    for run in read("push_t.json")["rows"]:
        mean, low, high = run["measures"]["coverage"]
        yield (run["policy"].rpartition(":")[2], share(run["successes"], run["episodes"]),
               f"{mean:.3f} [{low:.3f}, {high:.3f}]", f"{run['mean_length']:.0f}")


def _beside_control(name: str, its: list[Run]) -> tuple[str, ...]:
    imagined = (
        share(*(sum(run[when][number] for run in its) for number in ("successes", "episodes")))
        for when in ("imagined_before", "imagined_after")
    )
    before, after, control = ([run[f"success_{when}"] for run in its] for when in ("before", "after", "control"))
    gain = points_over_seeds if len(its) > 1 else lambda first, last: points(first[0], last[0])
    beside = (_share(control), gain(before, control)) if any(control) else ("-", "-")
    return name, *imagined, _share(before), _share(after), gain(before, after), *beside


def _share(runs: Sequence[Sequence[bool]]) -> str:
    """Of all episodes; with an interval where they are of one run."""
    won = [bool(one) for run in runs for one in run]
    return share(sum(won), len(won)) if len(runs) == 1 else percent(sum(won) / len(won))
