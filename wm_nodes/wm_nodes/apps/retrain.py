"""Train a video model on a run's recorded clips and scores, without sampling: the same weights, file for file.

    wm retrain runs/RUN [--run-dir NEW] [--rewards.scenery -10]

The run must have kept all of its rollout buffers (train-video-model --keep-buffers). With --rewards.NAME the recorded
scores are mixed anew.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wm_nodes.apps.options import (
    OPTION_OF,
    add_device,
    add_run_dir,
    add_settings,
    add_tensorboard,
    open_run,
    prepare_torch,
    settings,
)
from wm_nodes.apps.video_results import conclude
from wm_nodes.config.load import VIDEO, load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import compute_device
from wm_nodes.core.progress import tqdm
from wm_nodes.reports.stages import Stages
from wm_nodes.training.run_record import CONFIG, Starter
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl import recorded_buffers
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.train import post_train
from wm_nodes.video_rl.training_run import VideoRun, progress
from wm_nodes.video_rl.validation import validation_scores


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run_folder", type=Path, metavar="run", help="run folder with all of its rollout buffers")
    add_run_dir(parser)
    add_settings(parser, VIDEO)
    add_device(parser)
    add_tensorboard(parser)
    parser.set_defaults(tensorboard=None)


def run(arguments: argparse.Namespace) -> None:
    """Train in a new run folder and measure as train-video-model does."""
    prepare_torch()
    source, live = recorded_buffers.read_run(arguments.run_folder)
    if arguments.run_dir and arguments.run_dir.expanduser().absolute() == source:
        raise ValueError(f"{source} is the run to train again from; name a new folder with --run-dir")

    def load(file: str, changes: dict[str, Any], chosen: Mapping[str, Any]) -> VideoRlConfig:
        return load_video_config(file or str(source / CONFIG), changes)

    def check(config: VideoRlConfig) -> None:
        compute_device(config.device)
        if config.seed != live.seed:
            raise ValueError(
                f"the clips of {source} were drawn with seed {live.seed}, not {config.seed}; do not set it"
            )

    starter = Starter("retrain", load, {"run_folder": None}, {"tensorboard": True}, OPTION_OF, prefix="--")
    opened = open_run(
        arguments, starter, settings(arguments), name=lambda config: "world_model_retrain", check=check
    )
    with opened as (config, run_dir):
        _run(arguments, source, live, config, run_dir)


def _run(
    arguments: argparse.Namespace, source: Path, live: VideoRlConfig, config: VideoRlConfig, run_dir: Path
) -> None:
    stage = Stages()
    _, iterations = progress(source)
    if not iterations:
        raise ValueError(f"{source} has no checkpoint of a learner: nothing was trained there to train again")
    clips = recorded_buffers.trained_clips(recorded_buffers.recorded_bags(source), iterations)
    stage(f"training on {len(clips)} buffers of {source} in {run_dir}")
    base, judge = source / "video_model", shipped_model(config.task)
    heldout = recorded_buffers.recorded_episodes(source, "heldout")
    device = compute_device(config.device)
    folder = load_video_folder(base, device)
    training = VideoRun(
        folder.network, config, run_dir, tensorboard=arguments.tensorboard,
        heldout=validation_scores(folder, heldout, judge, config) if config.evaluation.every else None,
    )
    rewards = None if config.rewards == live.rewards else config.rewards
    left = tqdm(clips[training.iterations :], desc="GRPO", unit="buffer")
    try:
        for _ in post_train(training, (recorded_buffers.recorded_buffer(source, one, rewards) for one in left)):
            pass
    finally:
        training.close()
    conclude(
        config, run_dir, base=base, iterations=training.iterations, version=training.version,
        heldout=load_clips(heldout, folder.clip["stride"], config.clip_steps, config.task),
        probe=load_probe(judge, device), preset=f"as in {source.name}", bag="", command=arguments.command,
        minutes=stage.minutes,
    )
