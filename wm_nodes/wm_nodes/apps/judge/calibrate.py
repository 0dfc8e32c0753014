"""Calibrate the embedded judge on recordings in which nothing is wrong: the normal ranges of a world model's clips.

    wm judge calibrate MODEL_DIR BAG [BAG ...] [--stride 2]

The bags hold episodes in the model's cameras, done and undone, such as wm collect makes; 100 or more, better 500. Each
is measured as recorded, as the model draws it, as the model imagines it and with a harmless change. What goes further
than 97 % of them is refused; no fault is shown. The ranges are written into MODEL_DIR, which is then a judge:
--judge MODEL_DIR. A clip is judged by the ranges of its frame rate, so each stride needs its own.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from wm_nodes.apps.options import add_device, add_seed, positive
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.environments.object_reader import reader_of
from wm_nodes.judge.one_class.calibration import MOVING, calibrate
from wm_nodes.judge.one_class.ranges import KEPT, NAMES, save_ranges
from wm_nodes.recording import read_episodes
from wm_nodes.world_model import load_model_folder


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model_dir", type=Path, help="world-model folder, with a position probe")
    parser.add_argument("bags", type=Path, nargs="+", help="recorded episodes in the model's cameras")
    parser.add_argument("--stride", type=positive, default=1, help="steps between two frames of a clip (default: 1)")
    parser.add_argument(
        "--moving", nargs="*", default=list(MOVING), metavar="CAMERA", help="cameras that move (default: wrist)"
    )
    add_seed(parser)
    add_device(parser, CPU)


def run(arguments: argparse.Namespace) -> None:
    """Write the ranges and print how far recordings go."""
    models = load_model_folder(arguments.model_dir, compute_device(arguments.device))
    episodes = [episode for bag in arguments.bags for episode in read_episodes(bag)]
    ranges = calibrate(
        models, episodes, stride=arguments.stride, seed=arguments.seed, moving=arguments.moving,
        reader=reader_of(arguments.model_dir, models.spec),
    )
    path = save_ranges(arguments.model_dir, replace(ranges, story={**ranges.story, "command": arguments.command}))
    print(
        f"{path}: {ranges.story['recordings']} recordings, {len(NAMES)} numbers; "
        f"{ranges.lengths[0]} to {ranges.lengths[1]} frames"
    )
    print(
        f"strangest number of a recording, in spreads: median {ranges.limit(0.5):.2f}, limit at {KEPT:.0%} "
        f"{ranges.limit():.2f}, largest {ranges.scores[-1]:.2f}"
    )
    for task, signal in ranges.done.items():
        print(f"{task}: done from a signal of {signal:.3f}")
