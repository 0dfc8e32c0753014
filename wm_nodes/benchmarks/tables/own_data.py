"""Rows of the tables of docs/results/own_data.md; what they are about stands in pages.yaml."""

from benchmarks.tables.table import Rows, interval, lines, points, share

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
