"""Simulator episodes into bags: the collector of environments/maniskill with the writer of recording."""

from pathlib import Path

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import model_tasks
from wm_nodes.core.specs import simulation_spec
from wm_nodes.core.types import Episode
from wm_nodes.environments.maniskill.collection import CollectionPlan, collect
from wm_nodes.recording import EpisodeBagWriter

TRAINING_SEEDS, HELDOUT_SEEDS = 0, 500_000
"""First reset seeds of the training and the held-out episodes; evaluation seeds start at evaluation.first_seed."""


def acceptance_plan(config: RunConfig) -> CollectionPlan:
    """Return the plan of the held-out episodes that decide about accepting a model."""
    return scripted_plan(config, min(config.acceptance.num_episodes, config.data.num_heldout), HELDOUT_SEEDS)


def scripted_plan(config: RunConfig, num_episodes: int, first_seed: int) -> CollectionPlan:
    """Return the plan of episodes of the scripted behaviours, for the world model that serves the configured task."""
    return CollectionPlan(
        task=model_tasks(config.task)[-1],  # one scene and one data set for all tasks of a model
        simulation=config.simulation,
        num_episodes=num_episodes,
        first_seed=first_seed,
        behaviours=config.data.behaviours,
    )


def demonstration_plan(config: RunConfig, num_episodes: int, first_seed: int) -> CollectionPlan:
    """Return the plan of MPLib demonstrations of the configured task, for behaviour cloning."""
    return CollectionPlan(
        task=config.task, simulation=config.simulation, num_episodes=num_episodes, first_seed=first_seed,
        behaviours={"expert": 1.0}, end_on_success=True,
    )


def first_frames_plan(config: RunConfig, num_episodes: int, first_seed: int) -> CollectionPlan:
    """Return the plan of episodes of one step: first frames to imagine from."""
    one_step = config.simulation.model_copy(update={"max_episode_steps": 1})
    return CollectionPlan(config.task, one_step, num_episodes, first_seed, behaviours={"random": 1.0})


def collect_plan(plan: CollectionPlan, config: RunConfig, folder: Path) -> list[Path]:
    """Collect the plan's episodes into bags below `folder`; see collect."""
    return collect(folder, plan, write_shard, num_workers=config.data.num_workers)


def write_shard(path: Path, plan: CollectionPlan, episodes: list[Episode]) -> None:
    """Write one shard's episodes into a bag that is renamed to `path` when complete."""
    spec = simulation_spec(plan.task, plan.simulation, 1)
    custom = {"wm.seeds": f"{episodes[0].seed}..{episodes[-1].seed}"}
    run_id = path.parent.name
    with EpisodeBagWriter(path, spec, run_id=run_id, custom=custom, start_ns=1, discard_partial=True) as writer:
        for episode in episodes:
            writer.write(episode)
