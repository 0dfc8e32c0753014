"""A video model's clips as episodes that train a policy: no demonstration is needed.

    wm follow-clips runs/RUN --out BAG [--episodes 200]
    wm train-policy --task TASK --demos BAG --sft.num_demonstrations 200

RUN is one of train-video-model --preset outcome, best with --reward execution. Its video model makes a clip from the
first frame of each of the run's training recordings, and another of each while episodes are missing. The action world
model follows each clip's motion (as the reward execution does). What it imagines on the way, pictures, states and
actions at control rate, is an episode where its done signal says that the task got done. Nothing else of a recording
is seen, and BAG says that it is imagined. It can be watched with wm view.
"""

import argparse
from pathlib import Path

from wm_nodes.apps.options import add_device, device_settings, positive, prepare_torch
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import compute_device
from wm_nodes.core.progress import tqdm
from wm_nodes.training.weights import load_weights_file
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.followed_episodes import write_followed_episodes
from wm_nodes.video_rl.recorded_buffers import read_run, recorded_episodes
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.training_run import VIDEO_FILES, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run_folder", type=Path, metavar="run", help="run folder of train-video-model")
    parser.add_argument("--out", type=Path, required=True, help="folder of the new bag")
    parser.add_argument("--episodes", type=positive, default=200, help="to be accepted (default: 200)")
    parser.add_argument(
        "--version", type=int,
        help="of the video model, as in <run>/video_policies; 0: before training (default: the newest)",
    )
    add_device(parser)


def run(arguments: argparse.Namespace) -> None:
    """Follow clips until enough are accepted, and write these."""
    prepare_torch()
    run_dir, config = read_run(arguments.run_folder, device_settings(arguments))
    device = compute_device(config.device)
    folder, probe = load_video_folder(run_dir / "video_model", device), load_probe(shipped_model(config.task), device)
    version = progress(run_dir)[0] if arguments.version is None else arguments.version
    if version:
        load_weights_file(folder.network, run_dir / VIDEO_FILES.uri(version))
    bags = recorded_episodes(run_dir, "train")
    recordings = load_clips(bags, config.model.stride, config.clip_steps, config.task)
    said = ""
    with tqdm(total=arguments.episodes, desc="accepted clips", unit="episode") as bar:

        def show(accepted: int, followed: int) -> None:
            nonlocal said
            said = f"{accepted} of {followed} clips were accepted"
            bar.update(min(accepted, arguments.episodes) - bar.n)

        write_followed_episodes(
            arguments.out, folder, recordings, config, probe, arguments.episodes, version=version, on_progress=show
        )
    print(f"{said}; {arguments.out}: {arguments.episodes} imagined episodes of {config.task}")
