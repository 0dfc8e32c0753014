"""Figures 4, 5 and 9 of RoboScape-R: what trained policies do, as film strips; and what the world model makes of
extreme actions, as numbers and as a film strip.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.table import Table

from benchmarks.environments.policies import Workplace
from benchmarks.environments.reward_test import shown
from wm_nodes.apps.policy_pictures import play, side_by_side
from wm_nodes.config.scenes import splits
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.seed_ranges import HELDOUT
from wm_nodes.core.types import UInt8Array
from wm_nodes.environments.collection import EXTREME
from wm_nodes.environments.record import collect_plan, task_plan
from wm_nodes.policy_rl.factories import models_of
from wm_nodes.recording import read_episodes
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.film_strip import film_strip
from wm_nodes.world_model.validation.controllability import controllability_metrics

SCRIPTED = "scripted"
"""The configured behaviours, the control of EXTREME."""


def draw_policies(place: Workplace, weights: Mapping[str, Path], scenes: Iterable[str], folder: Path) -> Iterator[Path]:
    """A film strip for each of `scenes`: the first evaluation episode of every policy in the simulator, none chosen; a
    green frame where it succeeds.

    Args:
        weights: of the policies, by label.
    """
    seed = place.config.evaluation.first_seed
    for name in scenes:
        rows, marks = dict[str, UInt8Array](), dict[str, int]()
        with place.simulator(name, num_envs=1) as env:
            for label, file in weights.items():
                episode = play(env, place.policy(file), seed)
                rows[label] = episode.images
                if episode.success.any():
                    marks[label] = int(episode.success.argmax())
        path = folder / f"{place.config.task}_{name}.png"
        film_strip(rows, path, marks=marks)
        yield path


def measure_extreme(config: RunConfig, model_dir: Path, work: Path) -> Iterator[dict[str, Any]]:
    """How rollouts of extreme actions obey them, beside those of scripted ones, in every domain; a film strip for each.

    An extreme action is at its limit in every component and held for some steps, see environments/maniskill/episodes.

    Args:
        work: folder of the episodes and of the pictures; episodes that are there are kept.
    """
    models, count = models_of(model_dir, config.device), config.evaluation.episodes
    for domain, (name, behaviours) in (
        (domain, kind) for domain in splits()
        for kind in ((SCRIPTED, config.data.behaviours), (EXTREME, {EXTREME: 1.0}))
    ):
        chosen = config.with_values(
            simulation=config.simulation.with_values(scenes=domain), data=config.data.with_values(behaviours=behaviours)
        )
        folder = work.absolute() / f"{config.task}_{domain}_{name}"
        bags = collect_plan(task_plan(chosen, count, HELDOUT.take(count)), chosen, folder)
        episodes = [episode for bag in bags for episode in read_episodes(bag)][:count]  # earlier calls may want more
        pair = side_by_side(models, episodes[:1], config)[0]
        film_strip(pair.rows, folder / "film_strip.png", marks=pair.done)
        found = controllability_metrics(models, stack_episodes(episodes, [config.task]), models.spec)
        yield {"task": config.task, "domain": domain, "actions": name, "episodes": count, "metrics": found,
               "picture": str(folder / "film_strip.png")}


def extreme_table(rows: Iterable[dict[str, Any]]) -> Table:
    """Of the rows of measure_extreme, at every horizon that they have."""
    first, *others = "psnr_shuffled_drop_db_h", "tool_command_cm_h", "tool_shuffled_cm_h"
    lines = [
        (row["task"], row["domain"], row["actions"], str(int(step)), shown(drop),
         *(shown(row["metrics"].get(f"{name}{step}")) for name in others))
        for row in rows for metric, drop in row["metrics"].items() if metric.startswith(first)
        for step in [metric.removeprefix(first)]
    ]
    return make_table(
        "rollouts of extreme actions",
        ("task", "scenes", "actions", "step", "PSNR less other actions', dB", "tool off its command, cm",
         "off another's, cm"), lines,
    )
