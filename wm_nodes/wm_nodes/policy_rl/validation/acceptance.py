"""Acceptance of the model that a policy is about to be trained in: a part of every training beside a simulator."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.seed_ranges import HELDOUT, SeedRange
from wm_nodes.environments.record import acceptance_plan, collect_plan, first_frames_plan, keep_plan
from wm_nodes.environments.registry import is_simulated, make_environment
from wm_nodes.policy_rl.device_rollout import unseen_pictures_left_out
from wm_nodes.policy_rl.factories import STARTS, make_imagined_environment, make_video_environment, models_of
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.initial_policy import write_starts
from wm_nodes.policy_rl.pretraining import load_arrays
from wm_nodes.policy_rl.validation.exploit_meter import IMAGINED_ENVS, imagine_and_replay
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.starts import load_start_seeds
from wm_nodes.world_model.validation.acceptance import (
    CloneRollouts,
    accept_video_model,
    accept_world_model,
    accepted_when_made,
    report_when_made,
)
from wm_nodes.world_model.validation.acceptance_report import AcceptanceReport


def accept_model(
    config: RunConfig, model_dir: Path, policy: ImagePolicy, imagined: tuple[int, int],
    real: tuple[int, int] | None, folder: Path, *, video_model_dir: Path | None = None,
) -> AcceptanceReport:
    """Measure whether a policy may be trained in the world model, or in the video model where one is given; without a
    simulator of the task, by what was measured when the world model was made.

    Args:
        policy: that training begins with. imagined, real: its (successes, episodes) in the model and in
            evaluation.environment; None: not measured.
        folder: of the held-out episodes; those of the same settings that are there are kept.

    Raises:
        ValueError: the folder was begun with other settings, and as accept_world_model.
    """
    if real is None or not is_simulated(config):
        return report_when_made(read_world_manifest(model_dir), config, imagined, real)
    plan = acceptance_plan(config)
    folder.mkdir(parents=True, exist_ok=True)
    keep_plan(plan, folder)
    bags = collect_plan(plan, config, folder)
    clone = tuple(_roll_out(config, model_dir, policy, bags, folder, video_model_dir))
    if video_model_dir is not None:
        return accept_video_model(config, imagined, real, clone)
    models = models_of(model_dir, config.device)
    return accept_world_model(models, load_arrays(bags, config, models.tasks), config, imagined, real, clone)


def acceptance_when_made(model_dir: Path | None, config: RunConfig) -> str:
    """Say in a line what acceptance makes of a world model's manifest, where there is no simulator to measure in."""
    if model_dir is None:
        return "there is none"
    return accepted_when_made(read_world_manifest(model_dir), config)


def _roll_out(
    config: RunConfig, model_dir: Path, policy: ImagePolicy, bags: list[Path], folder: Path,
    video_model_dir: Path | None,
) -> Iterator[CloneRollouts]:
    """Rollouts of the policy from the first frames of held-out episodes, and of each of acceptance.clone_scenes."""
    count, starts = config.acceptance.clone_episodes, folder / STARTS
    if not count:
        return
    write_starts(bags, starts, count)
    yield roll_out(config, starts, model_dir, policy, video_model_dir)
    for scenes in config.acceptance.clone_scenes if config.simulation.scenes else ():
        there = in_scenes(config, scenes, count, HELDOUT, folder / scenes)
        yield replace(roll_out(*there, model_dir, policy, video_model_dir), scenes=scenes)


def in_scenes(config: RunConfig, scenes: str, count: int, seeds: SeedRange, folder: Path) -> tuple[RunConfig, Path]:
    """The configuration of the task in other scenes, a value of simulation.scenes, and a file of `count` first frames
    there, collected below `folder`; those that are there are kept."""
    config = config.with_values(simulation=config.simulation.with_values(scenes=scenes))
    starts = folder / STARTS
    write_starts(collect_plan(first_frames_plan(config, count, seeds), config, folder), starts, count)
    return config, starts


def roll_out(
    config: RunConfig, starts: Path, model_dir: Path, policy: ImagePolicy, video_model_dir: Path | None = None
) -> CloneRollouts:
    """Play a policy in the model from every start of a file, and its actions again in the simulator."""
    make = make_imagined_environment if video_model_dir is None else make_video_environment
    seeds = load_start_seeds(starts, config.task)
    num_envs = min(len(seeds), IMAGINED_ENVS)
    env = make(config, video_model_dir or model_dir, starts, num_envs=num_envs, seed=config.seed)
    simulator = make_environment(config, config.evaluation.environment, num_envs=1, seed=0, pictures=False)
    try:
        with unseen_pictures_left_out(env, policy):
            return CloneRollouts(*imagine_and_replay(policy, env, simulator, seeds, config.seed))
    finally:
        simulator.close()
