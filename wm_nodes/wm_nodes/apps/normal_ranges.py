"""Measure the normal ranges of a world model's evidence on recordings in which nothing is wrong, as a rubric pack.

    wm normal-ranges MODEL_DIR BAG [BAG ...] --check BAG [BAG ...] --output bands.yaml
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import yaml

from wm_nodes.apps.options import add_device
from wm_nodes.config.load import named_pack
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.files import write_atomic
from wm_nodes.core.progress import tqdm
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.training.normal_ranges import Row, bands_of, clip_rows, count_outside
from wm_nodes.recording import read_episodes
from wm_nodes.world_model import WorldModels, load_model_folder


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model_dir", type=Path, help="world-model folder")
    parser.add_argument("bags", type=Path, nargs="+", help="recorded episodes in the model's cameras")
    parser.add_argument("--check", type=Path, nargs="+", default=[], help="further bags: how many leave the bands?")
    parser.add_argument("--output", type=Path, required=True, help="the pack, a .yaml file")
    parser.add_argument("--rubric", default="robot", help="pack that it extends")
    parser.add_argument("--stride", type=int, default=1, help="steps between two frames of a clip")
    parser.add_argument("--tail", type=float, default=0.005, help="share of the clips outside of each band")
    add_device(parser, CPU)


def run(arguments: argparse.Namespace) -> None:
    """Write the pack and print its bands."""
    if arguments.stride < 1 or arguments.output.suffix != ".yaml":
        raise ValueError(f"--stride must be >= 1 and --output a .yaml, got {arguments.stride}, {arguments.output}")
    device = compute_device(arguments.device)
    base, models = load_rubric(arguments.rubric), load_model_folder(arguments.model_dir, device)
    rows = _rows(models, arguments.bags, arguments.stride)
    pack = {
        "extends": named_pack(arguments.rubric), "name": arguments.output.stem, "revision": base.revision,
        "evidence": bands_of(rows, arguments.tail),
    }
    head = f"# {arguments.command}\n# from {len(rows)} clips\n"
    write_atomic(arguments.output, (head + yaml.safe_dump(pack, sort_keys=False)).encode())
    rubric = load_rubric(str(arguments.output))
    checked = _rows(models, arguments.check, arguments.stride)
    print(f"{arguments.output}: rubric {rubric.version}; {len(rows)} clips, {len(checked)} to check")
    counts = {"bands": count_outside(rows, rubric), "check": count_outside(checked, rubric)}
    print(f"{'evidence':22} {'component':16} {'low':>9} {'high':>9} {'outside':>8} {'check':>6}")
    for name, band in rubric.evidence.items():
        numbers = f"{band.low:9.4g} {band.high:9.4g} {counts['bands'][name]:8} {counts['check'][name]:6}"
        print(f"{name:22} {band.component:16} {numbers}")
    print(f"{'any of them':59} {counts['bands']['any']:8} {counts['check']['any']:6}")


def _rows(models: WorldModels, bags: Sequence[Path], stride: int) -> list[tuple[Row, bool]]:
    episodes = (episode for bag in bags for episode in read_episodes(bag))
    return list(tqdm(clip_rows(models, episodes, stride), desc="measured", unit="clip"))
