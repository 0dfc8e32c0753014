"""Collect episodes of tasks in the simulator into bags: demonstrations, suboptimal trajectories, near misses.

    wm collect FOLDER --tasks pick_place,push --episodes 500 [--simulation.scenes ood_object]

Each task has its own shares of behaviours (data.behaviours). FOLDER/<task>/index.csv lists the episodes,
FOLDER/success.txt counts successes by behaviour and by scene. The same command goes on where it was interrupted, one
with more --episodes where the former ended.
"""

import argparse
from pathlib import Path

from wm_nodes.apps.options import add_preset, positive, settings
from wm_nodes.config.load import load_config
from wm_nodes.config.seed_ranges import EVALUATION
from wm_nodes.config.tasks import check_task, task_names
from wm_nodes.core.files import write_atomic
from wm_nodes.environments.record import collect_plan, keep_plan, read_index, success_table, task_plan


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="gets one folder of bags for each task; an existing one goes on")
    parser.add_argument("--tasks", required=True, help=f"separated by commas, of {', '.join(task_names())}")
    parser.add_argument("--episodes", type=positive, required=True, help="of each task")
    parser.add_argument("--first-seed", type=int, default=0, help="reset seed of the first (default: 0)")
    add_preset(parser, "cpu")


def run(arguments: argparse.Namespace) -> None:
    """Collect one task after the other and print the successes by behaviour."""
    chosen = {task: load_config(arguments.preset, {**settings(arguments), "task": task})
              for task in map(check_task, arguments.tasks.split(","))}
    bags = list[Path]()
    for task, config in chosen.items():
        if not 0 <= arguments.first_seed <= EVALUATION.first - arguments.episodes:
            raise ValueError(
                f"--first-seed {arguments.first_seed} and {arguments.episodes} episodes are not below "
                f"{EVALUATION.first}, from where on seeds are those of the evaluation; choose a lower one"
            )
        plan = task_plan(config, arguments.episodes, arguments.first_seed)
        keep_plan(plan, arguments.folder / task)
        bags += collect_plan(plan, config, arguments.folder / task)
    rows = read_index(bags)
    tables = [success_table(rows, "task", second) for second in ("behaviour", "scene")]
    write_atomic(arguments.folder / "success.txt", ("\n\n".join(tables) + "\n").encode())
    print(tables[0], f"by scene: {arguments.folder / 'success.txt'}", sep="\n")
