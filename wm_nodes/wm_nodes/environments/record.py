"""Simulator episodes into bags: the collector of environments/maniskill with the writer of recording."""

import csv
import io
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from wm_nodes.config.environments import TRUTH, SimulationConfig
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.seed_ranges import HELDOUT, STARTS, SeedRange, demonstration_seeds
from wm_nodes.config.tasks import get_task, model_tasks, recorded_task
from wm_nodes.core.files import write_atomic
from wm_nodes.core.types import Episode
from wm_nodes.environments import collection
from wm_nodes.environments.collection import CollectionPlan, PolicyAct, collect
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.recording import Bag, EpisodeBagWriter
from wm_nodes.training.contents import content_of

INDEX, PLAN = "index.csv", "plan.json"
FROM_TABLE = ("task", "seed", "behaviour", "instruction")
INDEX_COLUMNS = ("bag", "task", "scene", "seed", "behaviour", "success", "steps", "planner", "instruction")


def acceptance_plan(config: RunConfig) -> CollectionPlan:
    """Return the plan of the held-out episodes that decide about accepting a model."""
    return scripted_plan(config, min(config.acceptance.num_episodes, config.data.num_heldout), HELDOUT)


def scripted_plan(config: RunConfig, num_episodes: int, seeds: SeedRange) -> CollectionPlan:
    """Return the plan of episodes of the scripted behaviours in the configured task's scene, for its world model."""
    return CollectionPlan(
        task=recorded_task(config.task),
        simulation=config.simulation,
        num_episodes=num_episodes,
        first_seed=seeds.take(num_episodes),
        behaviours=config.data.behaviours,
    )


def model_configs(config: RunConfig) -> list[RunConfig]:
    """The configuration for each task that episodes are recorded for, of those that the configured one's world model
    serves; the other ones' shares of behaviours are their own."""
    tasks = dict.fromkeys(map(recorded_task, model_tasks(config.task)))
    if len(tasks) == 1:
        return [config]
    shares = {task: get_task(task).settings.get("data.behaviours", config.data.behaviours) for task in tasks}
    shares[config.task] = config.data.behaviours
    return [
        config.with_values(task=task, data=config.data.with_values(behaviours=shares[task])) for task in tasks
    ]


def collect_scripted(
    config: RunConfig, num_episodes: int, seeds: SeedRange, folder: Path, *, behaviour: str = ""
) -> dict[str, list[Path]]:
    """Collect the plan scripted_plan of each of model_configs into bags below `folder`, one folder for each task where
    there are several; returns the bags by task. behaviour: the only one, instead of the configured shares."""
    configs = model_configs(config)
    if behaviour:
        configs = [one.with_values(data=one.data.with_values(behaviours={behaviour: 1.0})) for one in configs]
    folders = [folder / one.task if len(configs) > 1 else folder for one in configs]
    return {
        one.task: collect_plan(scripted_plan(one, num_episodes, seeds), one, where)
        for one, where in zip(configs, folders, strict=True)
    }


def task_plan(config: RunConfig, num_episodes: int, first_seed: int) -> CollectionPlan:
    """Return the plan of episodes of the configured task alone, in the shares of data.behaviours."""
    return CollectionPlan(config.task, config.simulation, num_episodes, first_seed, config.data.behaviours)


def demonstration_plan(config: RunConfig, num_episodes: int, first_seed: int | None = None) -> CollectionPlan:
    """Return the plan of MPLib demonstrations of the configured task in sft.scenes, for behaviour cloning. first_seed:
    None: of the configuration's root seed."""
    if first_seed is None:
        first_seed = demonstration_seeds(config.seed, num_episodes)
    simulation = config.simulation.with_values(scenes=config.sft.scenes or config.simulation.scenes)
    return CollectionPlan(
        task=config.task, simulation=simulation, num_episodes=num_episodes, first_seed=first_seed,
        behaviours={"expert": 1.0}, end_on_success=True,
    )


def recovery_plan(config: RunConfig, make_policy: Callable[[], PolicyAct], planned: int) -> CollectionPlan:
    """Return the plan of twice sft.recoveries episodes, each begun by a policy and ended by the script, where
    demonstrations are planned; on the reset seeds that follow theirs, of which there are `planned`."""
    count = 2 * config.sft.recoveries
    plan = demonstration_plan(config, count, demonstration_seeds(config.seed, planned + count) + planned)
    return replace(plan, behaviours={}, make_policy=make_policy, recovers=True)


def first_frames_plan(config: RunConfig, num_episodes: int, seeds: SeedRange = STARTS) -> CollectionPlan:
    """Return the plan of episodes of one step: first frames to imagine from."""
    one_step = config.simulation.model_copy(update={"max_episode_steps": 1})
    return CollectionPlan(config.task, one_step, num_episodes, seeds.take(num_episodes), behaviours={"random": 1.0})


def collect_plan(plan: CollectionPlan, config: RunConfig, folder: Path) -> list[Path]:
    """Collect the plan's episodes into bags below `folder`, see collect, and list them in its index.csv.

    Raises:
        ValueError: a bag is there that an earlier call for fewer episodes left short.
    """
    bags = collect(folder, plan, write_shard, num_workers=config.data.num_workers)
    held = Counter(row["bag"] for row in write_index(folder))
    for number, bag in enumerate(bags):
        wanted = min(collection.EPISODES_PER_SHARD, plan.num_episodes - number * collection.EPISODES_PER_SHARD)
        if held[bag.name] < wanted:
            raise ValueError(f"{bag} was made for fewer episodes: it holds {held[bag.name]}, and {wanted} are wanted; "
                             "delete it to have it made again")
    return bags


def as_compared(simulation: SimulationConfig) -> dict[str, Any]:
    """The settings that recordings follow from, a reader by its content: its folder may be moved, or copied."""
    values = simulation.model_dump(mode="json", exclude={"render_device"})
    if simulation.object_state not in ("", TRUTH) and (content := content_of(simulation.object_state)):
        values["object_state"] = f"sha256 {content}"
    return values


def keep_plan(plan: CollectionPlan, folder: Path) -> None:
    """Write the plan into a folder of its bags alone.

    Raises:
        ValueError: the folder was begun with another plan; more episodes are none, but for a short last bag.
    """
    path, text = folder / PLAN, json.dumps({**vars(plan), "simulation": as_compared(plan.simulation)}, default=str)
    if path.exists() and path.read_text(encoding="utf-8") != text:
        kept, now = json.loads(path.read_text(encoding="utf-8")), json.loads(text)
        others = [name for name, value in now.items() if kept.get(name, value) != value]
        count, wanted = kept.get("num_episodes", 0), plan.num_episodes
        if others and (others != ["num_episodes"] or wanted < count):
            name, value = others[0], now[others[0]]
            raise ValueError(f"{folder} was begun with {name} {kept.get(name)}, not {value}; take another folder")
        short = count % collection.EPISODES_PER_SHARD
        last = folder / f"shard_{plan.first_seed + count - short:08d}"
        if others and short and last.exists():
            raise ValueError(f"{last} holds the last {short} of {count} episodes; delete it to go on to {wanted}")
    write_atomic(path, text.encode())


def read_index(bags: Sequence[Path]) -> list[dict[str, Any]]:
    """A row (INDEX_COLUMNS) of every episode of the bags. success: at any step. planner: why there was no plan."""
    rows = list[dict[str, Any]]()
    for path in bags:
        with Bag(path) as bag:
            for row in bag.episode_table():
                found = row["success"] or bool(row["return_total"])
                extra = row["extra"] or {}
                rows.append({
                    "bag": path.name, "scene": "", "planner": "", **extra, **{name: row[name] for name in FROM_TABLE},
                    "steps": row["length"], "success": found,
                })
    return [{name: row[name] for name in INDEX_COLUMNS} for row in rows]


def write_index(folder: Path) -> list[dict[str, Any]]:
    """Write index.csv, what read_index finds in the complete bags of the folder, and return it."""
    text, rows = io.StringIO(), read_index(sorted(path for path in folder.glob("shard_*") if not path.suffix))
    writer = csv.DictWriter(text, INDEX_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomic(folder / INDEX, text.getvalue().encode())
    return rows


def success_table(rows: Sequence[Mapping[str, Any]], *by: str) -> str:
    """Episodes, successes, steps and missing plans of index rows, by the values of some columns."""
    groups = dict[tuple[str, ...], list[Mapping[str, Any]]]()
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    widths = [max(len(name), *(len(key[i]) for key in groups)) for i, name in enumerate(by)]
    names = "  ".join(f"{name:{width}}" for name, width in zip(by, widths, strict=True))
    lines = [f"{names}  episodes  success  steps  without plan"]
    for key, group in sorted(groups.items()):
        wins, steps = sum(row["success"] for row in group), sum(row["steps"] for row in group)
        without = sum(bool(row["planner"]) for row in group)
        names = "  ".join(f"{name:{width}}" for name, width in zip(key, widths, strict=True))
        lines.append(f"{names}  {len(group):8}  {wins / len(group):7.1%}  {steps / len(group):5.1f}  {without:12}")
    return "\n".join(lines)


def write_shard(path: Path, plan: CollectionPlan, episodes: list[Episode]) -> None:
    """Write one shard's episodes into a bag that is renamed to `path` when complete."""
    spec = simulation_spec(plan.task, plan.simulation, 1)
    custom = {"wm.seeds": f"{episodes[0].seed}..{episodes[-1].seed}"}
    run_id = path.parent.name
    with EpisodeBagWriter(path, spec, run_id=run_id, custom=custom, start_ns=1, discard_partial=True) as writer:
        for episode in episodes:
            writer.write(episode)
