"""Train a video model on a run's recorded clips and scores, without sampling: the same weights, file for file.

    wm retrain runs/RUN [--run-dir NEW] [--set rewards.scenery=-10]

The run must have kept all of its rollout buffers (train-video-model --keep-buffers). With --set rewards.* the recorded
scores are mixed anew.
"""

import argparse
from pathlib import Path

from tqdm import tqdm

from wm_nodes.apps.options import add_run_dir, add_set, add_tensorboard, prepare_torch, settings
from wm_nodes.apps.policy_run import Stages, open_run_dir
from wm_nodes.apps.video_results import conclude
from wm_nodes.config.load import dump_config, load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl import recorded_buffers
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.training_run import VideoRun, progress
from wm_nodes.video_rl.validation import validation_scores


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run_folder", type=Path, metavar="run", help="run folder with all of its rollout buffers")
    add_run_dir(parser)
    add_set(parser)
    add_tensorboard(parser)


def run(arguments: argparse.Namespace) -> None:
    """Train in a new run folder and measure as train-video-model does."""
    prepare_torch()
    stage = Stages()
    source, live = recorded_buffers.read_run(arguments.run_folder)
    config = load_video_config(str(source / "config.yaml"), settings(arguments))
    if config.seed != live.seed:
        raise ValueError(f"the clips of {source} were drawn with seed {live.seed}, not {config.seed}; do not set it")
    run_dir = open_run_dir(arguments.run_dir, "world_model_retrain", dump_config(config))
    if run_dir == source:
        raise ValueError(f"{run_dir} is the run to train again from; name a new folder with --run-dir")
    _, iterations = progress(source)
    if not iterations:
        raise ValueError(f"{source} has no checkpoint of a learner: nothing was trained there to train again")
    clips = recorded_buffers.trained_clips(recorded_buffers.recorded_bags(source), iterations)
    stage(f"training on {len(clips)} buffers of {source} in {run_dir}")
    base, judge = source / "video_model", shipped_model(config.task)
    heldout = recorded_buffers.recorded_episodes(source, "heldout")
    folder = load_video_folder(base)
    training = VideoRun(
        folder.network, config, run_dir, tensorboard=arguments.tensorboard,
        heldout=validation_scores(folder, heldout, judge, config) if config.evaluation.every else None,
    )
    rewards = None if config.rewards == live.rewards else config.rewards
    try:
        for recorded in tqdm(clips[training.iterations :], desc="GRPO", unit="buffer"):
            training.train(recorded_buffers.recorded_buffer(source, recorded, rewards))
    finally:
        training.close()
    conclude(
        config, run_dir, base=base, iterations=training.iterations, version=training.version,
        heldout=load_clips(heldout, folder.clip["stride"]), probe=load_probe(judge), preset=f"as in {source.name}",
        bag="", command=arguments.command, minutes=stage.minutes,
    )
