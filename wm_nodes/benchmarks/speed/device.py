"""What a short time with a GPU should bring home, in one JSON."""

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from benchmarks.experiment import NO_OPTION, Experiment, console
from benchmarks.speed.device_agreement import COMPARED, agreement_points
from benchmarks.speed.device_models import Models, imagination_points, training_points
from benchmarks.speed.device_suite import CPU_PLAN, GPU_PLAN, INTERRUPTED, Plan, Point, Suite, number_text, spread_text
from wm_nodes.apps.cli import DIFFERENT, DONE
from wm_nodes.apps.cli import INTERRUPTED as STOPPED
from wm_nodes.core.device import CPU, compute_device, device_label
from wm_nodes.core.memory import keep_freed_memory
from wm_nodes.reports.console_table import make_table

NO_GPU = "nothing was measured on a GPU"


@dataclass(kw_only=True)
class DeviceSpeed(Experiment):
    """What a GPU makes of both loops, in five minutes and one process: imagined steps/s by number of environments and
    size of model, training, memory, and how far its numbers are from the CPU's.
    """

    device: str = "auto"
    """Where to measure: cpu, cuda, cuda:N or auto."""
    quick: bool = False
    """The plan of a CPU, for a first look at a GPU."""
    minutes: float | None = None
    """What would begin later is left out, and listed (default: 5)."""
    seed: int = 0
    """Of every random number."""
    plan: Plan | None = field(default=None, metadata=NO_OPTION)
    """None: the one for this device."""

    def run(self) -> int:
        """Measure the plan, show the tables, write --json; return the exit code."""
        device = compute_device(self.device)
        name = str(device)
        small = replace(CPU_PLAN, captured=name != CPU)
        plan = self.plan or (small if name == CPU or self.quick else GPU_PLAN)
        if self.minutes is not None:
            plan = replace(plan, minutes=self.minutes)
        if name != CPU:
            torch.cuda.set_device(device)
        keep_freed_memory()
        torch.set_num_threads(plan.threads or len(os.sched_getaffinity(0)))
        facts = {
            "device": device_label(device), "note": NO_GPU if name == CPU else "", "seed": self.seed,
            "configuration": asdict(plan), "torch_threads": torch.get_num_threads(), "numerics": numerics(),
        }

        def keep(suite: Suite) -> None:
            found = {"state": suite.state, "seconds": suite.spent_s, **suite.results, "skipped": suite.skipped}
            self.write(facts | found, device=name)

        suite = Suite(
            device, plan, lambda line: console.print(line, highlight=False, markup=False, soft_wrap=True), keep
        )
        suite.say(f"{facts['device']}, torch threads: {torch.get_num_threads()}, at most {plan.minutes:g} minutes")
        keep(suite)  # a file that cannot be written is found now
        with tempfile.TemporaryDirectory(prefix="wm_benchmark_") as folder:
            suite.run(all_points(plan, Models(name, self.seed, Path(folder)), name))
        keep(suite)
        for table in tables(suite.results):
            console.print(table)
        for line in closing_lines(suite, name):
            suite.say(line)
        if self.json is not None:
            suite.say(f"written to {self.json}")
        return STOPPED if suite.state == INTERRUPTED else DIFFERENT if suite.failed else DONE


def all_points(plan: Plan, models: Models, device: str) -> list[Point]:
    """In order of worth, since a time that ends leaves out the last ones."""
    return [
        *agreement_points(plan, models, device), *imagination_points(plan, models), *training_points(plan, models),
    ]


def numerics() -> dict[str, bool]:
    """What decides how exact float32 is on a GPU."""
    return {
        "tf32_products": torch.backends.cuda.matmul.allow_tf32, "tf32_convolutions": torch.backends.cudnn.allow_tf32,
    }


def tables(results: Mapping[str, Sequence[Mapping[str, Any]]]) -> Iterator[Table]:
    """What was measured: imagined steps/s by way, and the other groups."""
    if rows := results.get("imagination"):
        ways = list(dict.fromkeys(row["way"] for row in rows))
        cells: dict[tuple[Any, ...], dict[str, Mapping[str, Any]]] = {}
        for row in rows:
            cells.setdefault((row["model"], row["px"], row["envs"]), {})[row["way"]] = row
        yield make_table(
            "imagined steps/s with reward", ("model", "px", "environments", *ways, "peak memory, MiB"),
            (
                (*key, *(spread_text(found[way]) if way in found else "-" for way in ways),
                 number_text(max(row["peak_mib"] for row in found.values())))
                for key, found in cells.items()
            ),
        )
    if rows := [row for row in results.get("agreement", ()) if "terminated_equal" in row]:
        yield agreement_table(rows)
    if rows := results.get("training"):
        yield make_table(
            "training", ("what", "median", "unit", "n", "peak memory, MiB"),
            (
                (row["point"], spread_text(row), row["unit"], row["n"], number_text(row["peak_mib"])) for row in rows
            ),
            left=("what", "unit"),
        )


def agreement_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """How far a rollout on the device is from the CPU's."""
    return make_table(
        "the device's rollout against the CPU's", ("precision", "of", "largest", "mean", "largest, first step"),
        (
            (row["precision"], name.replace("_", " "),
             *(number_text(row[f"{name}_{what}"]) for what in ("largest", "mean", "first_largest")))
            for row in rows for name in COMPARED
        ),
        left=("precision", "of"), caption="; ".join(
            f"{row['precision']}: {100 * row['terminated_equal']:.2f} % of ends and sparse rewards are the same"
            for row in rows
        ),
    )


def closing_lines(suite: Suite, device: str) -> Iterator[str]:
    """What is not in the tables."""
    by_reason: dict[str, list[str]] = {}
    for left in suite.skipped:
        by_reason.setdefault(left["reason"], []).append(left["point"])
    for reason, points in by_reason.items():
        yield f"left out ({reason}): {'; '.join(points)}"
    for row in suite.results["agreement"]:
        if "columns" in row:
            same = f"{row['equal_columns']} of {row['columns']}"
            yield f"captured rollouts are the eager ones, bit for bit, in {same} columns"
    memory = "of this process" if device == CPU else "allocated on the GPU"
    yield f"±: half the distance between the 10 % and the 90 % quantile of the repeats; peak memory: {memory}"
    if device == CPU:
        yield NO_GPU
