"""Everything before RL: simulator episodes in, a world-model folder out. Resumable: finished stages are kept."""

import platform
from datetime import date
from pathlib import Path
from typing import Any

import torch

from wm_nodes.config.schema import RunConfig
from wm_nodes.learning.collecting import HELDOUT_SEEDS, TRAINING_SEEDS, collect_heldout_data, collect_training_data
from wm_nodes.learning.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.learning.gate import model_metrics
from wm_nodes.learning.text_model_training import DEMONSTRATORS, train_text_model
from wm_nodes.learning.tokenizer_training import train_tokenizer
from wm_nodes.learning.world_model_training import tokenise_episodes, train_action_model
from wm_nodes.recording import read_episodes
from wm_nodes.simulation.tasks import instruction, success
from wm_nodes.world_model import WorldModels, load_model_folder, save_model_folder

MODEL_TASKS = {"reach": ("reach", "push_cube"), "push_cube": ("reach", "push_cube"), "pull_cube": ("pull_cube",)}
"""Tasks that one world model serves, because they share a scene: one done output each."""


def load_arrays(bags: list[Path], config: RunConfig) -> EpisodeArrays:
    """Stack every episode of the bags, labelled for all tasks of the scene."""
    episodes = (episode for bag in bags for episode in read_episodes(bag))
    return stack_episodes(episodes, MODEL_TASKS[config.task], success, num_steps=config.simulation.max_episode_steps)


def make_model(config: RunConfig, run_dir: Path, *, progress: bool = True, command: str = "") -> Path:
    """Collect, train tokenizer, action model and text model, measure on held-out episodes; returns run_dir/model."""
    folder = run_dir / "model"
    if (folder / "manifest.json").exists():
        return folder
    bags = collect_training_data(config, run_dir / "data" / "train", progress=progress)
    heldout_bags = collect_heldout_data(config, run_dir / "data" / "heldout", progress=progress)
    episodes = load_arrays(bags, config)
    tokenizer, tokenizer_metrics = train_tokenizer(episodes, config, config.seed, run_dir, progress=progress)
    data = tokenise_episodes(tokenizer, episodes)
    action, action_metrics = train_action_model(tokenizer, data, config, config.seed, run_dir, progress=progress)
    texts = tuple(instruction(task) for task in MODEL_TASKS[config.task])
    golden = episodes.select([i for i, behaviour in enumerate(episodes.behaviours) if behaviour in DEMONSTRATORS])
    golden_data = tokenise_episodes(tokenizer, golden)
    text, text_metrics = train_text_model(
        tokenizer, action, golden, golden_data, texts, config, config.seed, run_dir, progress=progress
    )
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
