"""Rows of the tables of docs/results/fetch_reach.md; what they are about stands in pages.yaml."""

from benchmarks.tables.own_data import FILE
from benchmarks.tables.table import Rows, Run, lines, points, read, share


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
    before, after, control = (
        [bool(won) for run in its for won in run[f"success_{when}"]] for when in ("before", "after", "control")
    )
    real = (share(sum(won), len(won)) for won in (before, after))
    beside = (share(sum(control), len(control)), points(before, control)) if control else ("-", "-")
    return name, *imagined, *real, points(before, after), *beside
