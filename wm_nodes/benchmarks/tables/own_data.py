"""Rows of the tables of docs/results/own_data.md; what they are about stands in pages.yaml."""

from benchmarks.tables.table import Rows, Run, interval, lines, points, share

FILE = "own_data.jsonl"


def without_positions() -> Rows:
    for run in lines(FILE):
        if "control" in run:
            continue
        if pair := run.get("paired"):
            gain = interval(100 * pair["difference"], 100 * pair["low"], 100 * pair["high"], 1)
        else:
            gain = points(run["success_before"], run["success_after"])
        rates = [share(run[when]["successes"], run[when]["episodes"]) for when in (
            "imagined_before", "imagined_after", "real_before", "real_after"
        )]
        failed = "; ".join(name.split(":")[0] for name in run["acceptance"]["failed"])
        yield run["run"], *rates, gain, f"{run['acceptance']['outcome']}: {failed}"


def fetch_reach() -> Rows:
    """Runs of one model, beside PPO in the environment itself where that was made; then all seeds together."""
    made = [run for run in lines(FILE) if "control" in run]
    for run in made:
        yield _beside_control(run["run"], [run])
    for name in dict.fromkeys(run["run"].split(", seed")[0] for run in made):
        its = [run for run in made if run["run"].startswith(name)]
        yield _beside_control(f"{name}, {len(its)} seeds", its)


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
