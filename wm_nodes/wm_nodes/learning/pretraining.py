"""Everything before RL: demonstrations in, a model folder out. Resumable: finished stages and shards are kept."""

from pathlib import Path

from wm_nodes.config.schema import RunConfig
from wm_nodes.learning.collecting import collect_heldout_data, collect_training_data
from wm_nodes.learning.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.recording import read_episodes
from wm_nodes.simulation.tasks import success

MODEL_TASKS = {"reach": ("reach", "push_cube"), "push_cube": ("reach", "push_cube"), "pull_cube": ("pull_cube",)}
"""Tasks that one world model serves, because they share a scene: one done output each."""


def load_arrays(bags: list[Path], config: RunConfig) -> EpisodeArrays:
    """Stack every episode of the bags, labelled for all tasks of the scene."""
    episodes = (episode for bag in bags for episode in read_episodes(bag))
    return stack_episodes(
        episodes, MODEL_TASKS[config.task], success, num_steps=config.simulation.max_episode_steps
    )


def collect_all(config: RunConfig, data_dir: Path, *, progress: bool = True) -> tuple[list[Path], list[Path]]:
    """Training and held-out bags in data_dir/train and data_dir/heldout; missing shards are collected."""
    training = collect_training_data(config, data_dir / "train", progress=progress)
    return training, collect_heldout_data(config, data_dir / "heldout", progress=progress)
