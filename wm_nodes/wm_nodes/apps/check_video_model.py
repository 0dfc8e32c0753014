"""Check a video model before GRPO trains it: sampled videos, ratio, KL and mask, a line each; of an embedded
one what the best clip of a group is better by than the others, clip after clip on its own frames: where that closes
little of the gap to the codec, no group method can learn.

    wm check-video-model [--video-model FOLDER --context-bags BAG ... | --public FOLDER]
"""

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console
from torch import nn

from wm_nodes.apps.options import add_preset, positive, settings
from wm_nodes.config.load import VIDEO, load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import compute_device
from wm_nodes.reports.console_table import estimate, make_table
from wm_nodes.video_model import Condition
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_rl.checks import examine
from wm_nodes.video_rl.horizons import DRIFT, horizon_scores, measure_headroom
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.video_rl.toy_scene import CHANNELS, FRAMES, SIDE, draw_scenes, load_base

VIDEOS = 4
ModelToCheck = tuple[nn.Module, Condition, tuple[int, int, int, int], VideoRlConfig]
"""The model, what it is asked for, the shape of its latents (C, F, H, W), and the settings."""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--video-model", type=Path, help="folder of an embedded video model; default: the shipped toy")
    parser.add_argument("--context-bags", type=Path, nargs="+", help="bags to take first frames and actions from")
    parser.add_argument("--public", type=Path, help="diffusers folder of a public model (Wan, Cosmos-Predict2.5)")
    parser.add_argument("--prompt", default="a robot arm pushes a block across the table", help="for a public model")
    parser.add_argument("--text-only", action="store_true", help="give a public model no first frame")
    parser.add_argument("--picture", type=Path, help="first frame for a public model; default: a test card")
    parser.add_argument("--size", type=_size, default=(480, 832), metavar="HxW", help="pixels; default 480x832")
    parser.add_argument("--frames", type=int, default=9, help="frames of a clip; 4 n + 1 for Wan's VAE")
    parser.add_argument("--dtype", choices=("float32", "bfloat16", "float16"), default="float32")
    parser.add_argument("--lora-rank", type=int, default=0, help="check with a LoRA adapter of this rank")
    parser.add_argument("--contexts", type=positive, default=32, help="contexts whose groups show the head-room")
    add_preset(parser, "recommended", VIDEO)


def run(arguments: argparse.Namespace) -> int:
    """Print a line per check; return 1 where one failed."""
    config = load_video_config(arguments.preset, settings(arguments))
    recorded = _recorded(arguments, config)
    model, condition, shape, config = _model_to_check(arguments, config, recorded)
    findings = examine(model, condition, shape, config)
    title = f"{len(condition.actions)} videos of {' x '.join(map(str, shape))} latents (C x F x H x W)"
    columns = ("check", "", "found", "where it failed")
    marks = {True: "[green]passed", False: "[red]FAILED"}
    rows = ((f.name, marks[f.passed], f.value, "" if f.passed else f.remedy) for f in findings)
    console = Console()
    console.print(make_table(title, columns, rows, left=columns))
    if recorded is not None:
        _print_headroom(console, *recorded, arguments.contexts, config)
    return int(not all(finding.passed for finding in findings))


def _print_headroom(
    console: Console, folder: VideoFolder, clips: Clips, contexts: int, config: VideoRlConfig
) -> None:
    """Groups and whole rollouts of the first contexts, per clip, and in words whether groups can teach anything."""
    probe = load_probe(shipped_model(config.task), folder.device)
    clips = clips.first(contexts)
    found = measure_headroom(folder, clips, config, probe)
    frames = sample_by_ode(folder, clips, config, config.rollout.num_steps)
    drift = {name: float(values.mean()) for name, values in horizon_scores(frames, clips, probe, folder).items()}
    columns = (
        "clip", "reward", "best of n", "gain", "codec", "of the gap, at most", *(f"rollout {name}" for name in DRIFT)
    )
    rows = (
        (
            str(h.clips), f"{h.reward:.3f}", f"{h.best:.3f}", estimate(h.gain, ".3f"), f"{h.codec:.3f}",
            f"{h.share:.0%}", *(f"{drift[f'{name}_{h.clips}']:.2f}" for name in DRIFT),
        )
        for h in found
    )
    n = config.groups.group_size
    title = f"best of {n} clips against the mean, {len(clips)} contexts, 95 % bootstrap interval over them"
    console.print(make_table(title, columns, rows, left=()))


def _recorded(arguments: argparse.Namespace, config: VideoRlConfig) -> tuple[VideoFolder, Clips] | None:
    """The embedded model and the recordings to check it on; None for the toy and for a public model."""
    if arguments.public or arguments.video_model is None:
        return None
    if not arguments.context_bags:
        raise ValueError("--video-model needs --context-bags: recorded episodes to take first frames and actions from")
    folder = load_video_folder(arguments.video_model, compute_device(config.device))
    return folder, load_clips(arguments.context_bags, folder.clip["stride"], config.clip_steps, config.task)


def _model_to_check(
    arguments: argparse.Namespace, config: VideoRlConfig, recorded: tuple[VideoFolder, Clips] | None
) -> ModelToCheck:
    device = compute_device(config.device)
    if arguments.public:
        return _public(arguments, config, str(device))
    if recorded is None:
        toy = draw_scenes(VIDEOS, config.seed, "doctor").condition()
        return load_base(device=device), toy.to(device), (CHANNELS, FRAMES, SIDE, SIDE), config
    folder, clips = recorded
    clips = clips.first(VIDEOS)
    condition = clips.condition(folder.codec, folder.clip["num_conditioning"], folder.network.settings.text_dim)
    latents = folder.codec.encode(clips.frames)
    C, F, H, W = latents.shape[1:]
    return folder.network, condition, (C, F, H, W), config


def _public(arguments: argparse.Namespace, config: VideoRlConfig, device: str) -> ModelToCheck:
    from wm_nodes.video_model.adapters import add_lora, load_public_model

    public = load_public_model(arguments.public, dtype=arguments.dtype, device=device)
    frames = torch.from_numpy(np.stack([_picture(arguments)] * arguments.frames))[None]
    C, F, H, W = public.codec.encode(frames).shape[1:]
    condition = public.condition(frames[:, :1], [arguments.prompt], F).repeat_interleave(VIDEOS)
    if arguments.text_only:
        condition = condition.without_frames()
    model: Any = public.velocity
    if arguments.lora_rank:
        add_lora(model, arguments.lora_rank, 2 * arguments.lora_rank)
    return model, condition, (C, F, H, W), config.with_values(
        rollout=config.rollout.with_values(shift=public.shift)
    )


def _picture(arguments: argparse.Namespace) -> "np.ndarray[Any, np.dtype[np.uint8]]":
    """The first frame, uint8 (H, W, 3): the given picture, or a test card."""
    height, width = arguments.size
    if arguments.picture is None:
        across = np.linspace(0, 255, width, dtype=np.uint8)[None].repeat(height, 0)
        down = np.linspace(0, 255, height, dtype=np.uint8)[:, None].repeat(width, 1)
        return np.stack([across, down, 255 - across], -1)
    found = cv2.imread(str(arguments.picture))
    if found is None:
        raise ValueError(f"{arguments.picture} is no picture that OpenCV reads")
    resized: np.ndarray[Any, np.dtype[np.uint8]] = cv2.cvtColor(cv2.resize(found, (width, height)), cv2.COLOR_BGR2RGB)
    return resized


def _size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not (height.isdigit() and width.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no HEIGHTxWIDTH, e.g. 480x832")
    return int(height), int(width)
