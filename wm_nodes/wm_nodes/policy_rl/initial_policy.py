"""Prepare what a run needs besides a world model: first frames to imagine from, the weak policy that RL starts from."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.files import write_atomic
from wm_nodes.core.types import Episode
from wm_nodes.environments.record import collect_plan, demonstration_plan, first_frames_plan
from wm_nodes.policy_rl.behaviour_cloning import demonstrations, train_sft
from wm_nodes.policy_rl.factories import make_policy, make_reconstruct
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.recording import read_episodes
from wm_nodes.training.weights import save_weights

STARTS = "starts.safetensors"
MAX_STARTS, MODEL_STARTS = 512, 64
"""Most first frames of a run, and of those beside a model, from which a launch file imagines by default."""
NUM_STARTS = 256
DEMONSTRATION_SEEDS, START_SEEDS = 600_000, 700_000
SEEDS_PER_RUN = 1000


def num_starts(config: RunConfig) -> int:
    """Return the number of first frames of a run; imagined success is measured on as many episodes."""
    return min(NUM_STARTS, 8 * config.evaluation.episodes)


def write_starts(bags: Iterable[Path], path: Path, limit: int = MAX_STARTS) -> int:
    """Write the first frame and state of up to `limit` recorded episodes; returns how many."""
    episodes: list[Episode] = []
    for bag in bags:
        episodes += list(read_episodes(bag))
        if len(episodes) >= limit:
            break
    chosen = episodes[:limit]
    tensors = {
        "images": torch.from_numpy(np.stack([episode.images[0] for episode in chosen])),
        "states": torch.from_numpy(np.stack([episode.states[0] for episode in chosen])),
    }
    write_atomic(path, save(tensors))
    return len(chosen)


def train_weak_policy(config: RunConfig, model_dir: Path, demo_bags: Iterable[Path], path: Path) -> ImagePolicy:
    """Behaviour-clone a few demonstrations on raw and on tokenizer-reconstructed frames; write the weights to `path`.

    Raises:
        ValueError: the bags hold fewer successful demonstrations than sft.num_demonstrations.
    """
    policy = make_policy(config, model_dir)
    demos = demonstrations((e for bag in demo_bags for e in read_episodes(bag)), config.sft.num_demonstrations)
    train_sft(policy, demos, config.sft, config.seed, reconstruct=make_reconstruct(model_dir, config.device))
    save_weights(policy, path, {"tokenizer_sha256": policy.encoder.sha256})
    return policy


def start_files(run_dir: Path) -> tuple[Path, Path]:
    """Return the paths of a run's first frames and of its weak policy, as prepare_start writes them."""
    return run_dir / STARTS, run_dir / "policies" / "weak.safetensors"


def prepare_start(config: RunConfig, run_dir: Path, model_dir: Path) -> tuple[Path, Path]:
    """Collect demonstrations and first frames and train the weak policy, as far as missing; return start_files()."""
    spare = max(3, config.sft.num_demonstrations // 3)
    plan = demonstration_plan(
        config, config.sft.num_demonstrations + spare, DEMONSTRATION_SEEDS + SEEDS_PER_RUN * config.seed
    )
    demos = collect_plan(plan, config, run_dir / "bags" / "demos")
    starts, weak = start_files(run_dir)
    if not starts.exists():
        first_frames = first_frames_plan(config, num_starts(config), START_SEEDS)
        write_starts(collect_plan(first_frames, config, run_dir / "bags" / "starts"), starts)
    if not weak.exists():
        train_weak_policy(config, model_dir, demos, weak)
    return starts, weak
