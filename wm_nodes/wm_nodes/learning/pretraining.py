"""Everything before RL: simulator episodes in, a world-model folder out. Resumable: finished stages are kept."""

import copy
import platform
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import torch

from wm_nodes.config.schema import RunConfig
from wm_nodes.learning.collecting import (
    HELDOUT_SEEDS,
    TRAINING_SEEDS,
    collect_heldout_data,
    collect_plan,
    collect_training_data,
    demonstration_plan,
)
from wm_nodes.learning.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.learning.gate import model_metrics
from wm_nodes.learning.policies import policy_actor
from wm_nodes.learning.preparation import train_weak_policy
from wm_nodes.learning.text_model_training import DEMONSTRATORS, train_text_model
from wm_nodes.learning.token_model_training import train_token_model
from wm_nodes.learning.tokenizer_training import train_tokenizer
from wm_nodes.learning.world_model_training import tokenise_episodes, train_action_model
from wm_nodes.recording import read_episodes
from wm_nodes.simulation.collection import CollectionPlan
from wm_nodes.simulation.tasks import instruction, success
from wm_nodes.world_model import ActionModel, Tokenizer, WorldModels, load_model_folder, save_model_folder
from wm_nodes.world_model.token_dynamics import TokenActionModel

MODEL_TASKS = {"reach": ("reach", "push_cube"), "push_cube": ("reach", "push_cube"), "pull_cube": ("pull_cube",)}
"""Tasks that one world model serves, because they share a scene: one done output each."""
WEAK_POLICIES = (("push_cube", 3, 0.25), ("reach", 8, 0.25), ("push_cube", 4, 0.4), ("pull_cube", 4, 0.3))
"""(task, demonstrations cloned, exploration noise) of the policies whose episodes refresh the action model."""
POLICY_SEEDS = 300_000


def load_arrays(bags: list[Path], config: RunConfig) -> EpisodeArrays:
    """Stack every episode of the bags, labelled for all tasks of the scene."""
    episodes = (episode for bag in bags for episode in read_episodes(bag))
    return stack_episodes(episodes, MODEL_TASKS[config.task], success, num_steps=config.simulation.max_episode_steps)


def make_model(config: RunConfig, run_dir: Path, *, progress: bool = True, command: str = "") -> Path:
    """Collect, train tokenizer, action model and text model, measure on held-out episodes; returns run_dir/model.

    tokenizer.kind lfq has no text model, so no goals: set reward.dense_weight to 0 there.
    """
    folder = run_dir / "model"
    if (folder / "manifest.json").exists():
        return folder
    bags = collect_training_data(config, run_dir / "data" / "train", progress=progress)
    heldout_bags = collect_heldout_data(config, run_dir / "data" / "heldout", progress=progress)
    episodes = load_arrays(bags, config)
    tokenizer, tokenizer_metrics = train_tokenizer(episodes, config, config.seed, run_dir, progress=progress)
    data = tokenise_episodes(tokenizer, episodes)
    action: ActionModel | TokenActionModel
    text, text_metrics = None, dict[str, float]()
    if config.tokenizer.kind == "lfq":
        action, action_metrics = train_token_model(tokenizer, data, config, config.seed, run_dir, progress=progress)
    else:
        first, action_metrics = train_action_model(tokenizer, data, config, config.seed, run_dir, progress=progress)
        golden = episodes.select([i for i, behaviour in enumerate(episodes.behaviours) if behaviour in DEMONSTRATORS])
        texts = tuple(instruction(task) for task in MODEL_TASKS[config.task])
        text, text_metrics = train_text_model(
            tokenizer, first, golden, tokenise_episodes(tokenizer, golden), texts, config, config.seed, run_dir,
            progress=progress,
        )  # fmt: skip
        action = first
        if config.world_model.refresh.num_iterations:
            action, refreshed = _refresh(config, run_dir, tokenizer, first, episodes, progress)
            action_metrics |= {f"refresh_{name}": value for name, value in refreshed.items()}
    story: dict[str, Any] = {
        "made": {
            "command": command, "date": date.today().isoformat(), "seed": config.seed, "torch": torch.__version__,
            "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
        },
        "data": {
            "episodes": len(episodes), "training_seeds": [TRAINING_SEEDS, TRAINING_SEEDS + len(episodes) - 1],
            "behaviours": config.data.behaviours,
            "heldout_seeds": [HELDOUT_SEEDS, HELDOUT_SEEDS + config.data.num_heldout - 1],
        },
        "training": {"tokenizer": tokenizer_metrics, "action": action_metrics, "text": text_metrics},
    }  # fmt: skip
    arguments: dict[str, Any] = {
        "tokenizer_config": config.tokenizer, "world_model_config": config.world_model, "simulation": config.simulation,
        "tasks": MODEL_TASKS[config.task],
    }  # fmt: skip
    models = WorldModels(tokenizer, action, text, MODEL_TASKS[config.task], config.simulation, {})
    story["heldout"] = model_metrics(models, load_arrays(heldout_bags, config), config)
    save_model_folder(folder, tokenizer, action, text, story=story, **arguments)
    load_model_folder(folder)
    return folder


def _refresh(
    config: RunConfig, run_dir: Path, tokenizer: Tokenizer, action: ActionModel, episodes: EpisodeArrays, progress: bool
) -> tuple[ActionModel, dict[str, float]]:
    """Collect with cloned policies, then go on training a copy of the action model with full-horizon rollouts."""
    settings = config.world_model.refresh
    bags = [
        bag
        for number, (task, demonstrations, noise) in enumerate(WEAK_POLICIES)
        if task in MODEL_TASKS[config.task]
        for bag in _policy_bags(config, run_dir, tokenizer, action, number, task, demonstrations, noise, progress)
    ]
    together = EpisodeArrays.concatenate([episodes, load_arrays(bags, config)]) if bags else episodes
    horizon = config.simulation.max_episode_steps
    update = {
        "num_iterations": settings.num_iterations, "learning_rate": settings.learning_rate,
        "state_weight": settings.state_weight, "done_weight": settings.done_weight, "rollout_steps": [horizon],
    }  # fmt: skip
    changed = config.model_copy(update={"world_model": config.world_model.model_copy(update=update)})
    return train_action_model(
        tokenizer, together, changed, config.seed, run_dir / "refresh", progress=progress, model=copy.deepcopy(action)
    )


def _policy_bags(
    config: RunConfig, run_dir: Path, tokenizer: Tokenizer, action: ActionModel, number: int, task: str,
    demonstrations: int, noise: float, progress: bool,
) -> list[Path]:  # fmt: skip
    """Episodes of a policy cloned from a few demonstrations, acting with exploration noise."""
    folder = run_dir / "model_before_refresh"
    if not (folder / "manifest.json").exists():
        save_model_folder(
            folder, tokenizer, action, None, tokenizer_config=config.tokenizer, world_model_config=config.world_model,
            simulation=config.simulation, tasks=MODEL_TASKS[config.task], story={},
        )  # fmt: skip
    chosen = config.model_copy(
        update={"task": task, "sft": config.sft.model_copy(update={"num_demonstrations": demonstrations})}
    )
    weights = run_dir / "policies" / f"weak_{number}.safetensors"
    if not weights.exists():
        plan = demonstration_plan(chosen, demonstrations + 3, POLICY_SEEDS + 1000 * number)
        train_weak_policy(chosen, folder, collect_plan(plan, config, run_dir / "data" / "demos", progress), weights)
    plan = CollectionPlan(
        MODEL_TASKS[config.task][-1], config.simulation, config.world_model.refresh.policy_episodes,
        POLICY_SEEDS + 10_000 * (number + 1), {}, make_policy=partial(policy_actor, chosen, folder, weights, noise),
    )  # fmt: skip
    return collect_plan(plan, config, run_dir / "data" / "policy", progress)
