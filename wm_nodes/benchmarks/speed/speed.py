"""Speed, side by side in one run: DDS against one process, the world model against the simulator, stage by stage."""

import argparse
import os
import platform
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.experiment import Experiment, console
from benchmarks.speed.graph import measure_graph
from benchmarks.speed.inputs import Effort, prepare_model, random_model
from benchmarks.speed.simulator import IMAGINED_ENVS, measure_simulator
from benchmarks.speed.stages import measure_stages
from wm_nodes.apps import options
from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import with_reader
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.memory import keep_freed_memory
from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.machine import machine_facts

FULL, QUICK = Effort(60, 5000, 5, 30), Effort(3, 500, 2, 8)


@dataclass(kw_only=True)
class Speed(Experiment):
    """Speed, side by side in one run: DDS against one process, the world model against the simulator, stage by stage.

    With settings, the model has random weights and the size that they say.
    """

    quick: bool = False
    """A tenth of the work, for a first look; less exact."""
    preset: str = "cpu"
    """Model size: the name of a preset, or a .yaml."""
    task: str = "push_cube"
    """That both sides simulate."""
    model_dir: Path | None = None
    """World model to measure instead of the shipped one."""
    untrained: bool = False
    """Measure a model with random weights, of the preset's size but for the settings given."""
    seed: int = 0
    """Of every random number."""

    @classmethod
    def add_settings(cls, parser: argparse.ArgumentParser) -> None:
        options.add_settings(parser)

    @classmethod
    def settings_of(cls, arguments: argparse.Namespace) -> dict[str, Any]:
        return options.settings(arguments)

    def run(self) -> None:
        """Measure, show the tables, write --json.

        Raises:
            ValueError: options that do not go together.
        """
        changes = {name: value for name, value in self.settings.items() if name != "seed"}
        if (self.untrained and self.model_dir) or (changes and not self.untrained):
            raise ValueError("settings and --untrained are of a model with random weights; leave out --model-dir")
        config = load_config(self.preset, {**changes, "seed": self.seed, "task": self.task})
        with tempfile.TemporaryDirectory(prefix="wm_benchmark_") as name:
            folder = Path(name)
            model = random_model(config, folder / "model") if self.untrained else self.model_dir
            results = measure(config, QUICK if self.quick else FULL, folder, model)
        given = {"quick": self.quick, "preset": self.preset, "task": self.task, "seed": self.seed}
        results |= given | {"untrained": changes if self.untrained else None}
        show(results)
        self.write(results, exact=True)


def measure(config: RunConfig, effort: Effort, folder: Path, model_dir: Path | None = None) -> dict[str, Any]:
    """All four parts. Keys: graph_overhead, step_growth, imagined_over_simulator, imagined_over_stock_simulator,
    imagined_steps_per_s, and details."""
    keep_freed_memory()
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    model, starts, description = prepare_model(config, folder, model_dir)
    config = with_reader(config, model)
    console.print(f"world model: {description}; {torch.get_num_threads()} torch threads", highlight=False)
    results: dict[str, Any] = {"model": description, "torch_threads": torch.get_num_threads()}
    results |= measure_graph(config, effort, folder, model, starts)
    results |= measure_simulator(config, effort, model, starts)
    results["stages"] = measure_stages(config, effort, model, starts)
    return {**results, "machine": machine_facts(), "date": time.strftime("%Y-%m-%d"), "platform": platform.platform()}


def show(results: dict[str, Any]) -> None:
    """The tables on the screen."""
    graph, simulator, facts = results["graph"], results["simulator"], results["machine"]
    rows = [
        (
            "graph_overhead", f"{results['graph_overhead']:.3f}", "<= 1.10",
            f"{graph['num_envs']} x {graph['image']} step: {graph['dds_step_ms']:.1f} ms over DDS, "
            f"{graph['in_process_step_ms']:.1f} ms in one process, {graph['threads_each']} thread each; 95 %: "
            f"{graph['overhead_95'][0]:.2f} to {graph['overhead_95'][1]:.2f} over {graph['pairs']} pairs of episodes",
        ),
        (
            "step_growth", f"{results['step_growth']:.3f}", "about 1",
            f"{graph['growth_steps']} steps, first and last tenth: {graph['growth_first_ms']:.2f} and "
            f"{graph['growth_last_ms']:.2f} ms (10 % quantiles: {graph['growth_first_p10_ms']:.2f} and "
            f"{graph['growth_last_p10_ms']:.2f} ms)",
        ),
    ]
    for kind, what in (("simulator", "our scene"), ("stock_simulator", "its own task")):
        ratio, rate = results[f"imagined_over_{kind}"], simulator.get(f"{kind.removesuffix('_simulator')}_steps_per_s")
        processes = f"ManiSkill with rendering, {what}, {simulator['simulator_processes']} processes"
        missing = ("-", simulator["missing"] or "ManiSkill has no such task")
        value, measured = missing if ratio is None else (f"{ratio:.1f}", f"{processes}: {rate:.1f} steps/s")
        rows.append((f"imagined_over_{kind}", value, ">= 10", measured))
    rows.append((
        "imagined_steps_per_s", f"{results['imagined_steps_per_s']:.0f}", ">= 250",
        f"{simulator['imagined_envs']} environments with {simulator['reward']} reward",
    ))
    title = f"{facts['processor']}, {facts['cores']} cores, {results['date']}"
    columns, left = ("", "value", "goal", "measured"), ("", "goal", "measured")
    console.print(make_table(title, columns, rows, left=left, caption=results["model"], no_wrap=("",)))
    stages = ((name, f"{v['ms']:.1f}", f"{v['peak_mib']:.1f}") for name, v in results["stages"].items())
    console.print(make_table(f"one batch of {IMAGINED_ENVS}", ("stage", "ms", "peak memory, MiB"), stages))
