"""Rows of the tables of docs/results/speed.md and docs/devices.md; what they are about stands in pages.yaml."""

from benchmarks.tables.table import Rows, Run, percent, read, runs

RUNS, DEVICE = "speed.jsonl", "speed_device.json"
WAYS = ("loop over host arrays", "eager", "captured")


def summary() -> Rows:
    for name, run in runs(RUNS).items():
        low, high = run["graph"]["overhead_95"]
        ratios = (run["imagined_over_simulator"], run.get("imagined_over_stock_simulator"))
        yield (
            name, f"{run['graph_overhead']:.2f} [{low:.2f}, {high:.2f}]", f"{run['step_growth']:.2f}",
            f"{run['imagined_steps_per_s']:.0f}", *("" if one is None else f"{one:.1f}" for one in ratios),
        )


def stages() -> Rows:
    first, second = (runs(RUNS)[name]["stages"] for name in ("full, 1", "full, 2"))
    for stage in first:
        yield stage, *(f"{of[stage]['ms']:.1f}" for of in (first, second))


def imagination_on_a_device() -> Rows:
    points: dict[tuple[str, int], dict[str, Run]] = {}
    for one in read(DEVICE)["imagination"]:
        points.setdefault((f"{one['model']}, {one['px']} px", one["envs"]), {})[one["way"]] = one
    for (model, envs), by_way in points.items():
        rates = (f"{by_way[way]['median']:,.0f}" if way in by_way else "" for way in WAYS)
        yield model, envs, *rates, gib(max(by_way.values(), key=lambda one: one["peak_mib"]))


def training_on_a_device() -> Rows:
    for one in read(DEVICE)["training"]:
        yield f"{one['trained']}, {one['model']}, {one['px']} px", one["batch"], f"{one['median']:.0f}", gib(one)


def agreement() -> Rows:
    for one in read(DEVICE)["agreement"]:
        if "terminated_equal" in one:
            yield one["precision"], percent(one["terminated_equal"])


def gib(point: Run) -> str:
    return f"{point['peak_mib'] / 1024:.1f}"
