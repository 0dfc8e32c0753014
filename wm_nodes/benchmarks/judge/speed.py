"""How many clips the embedded judge reads per second. The aim: 20 on 2 cores at 96 px and 25 frames.

    wm benchmark judge speed [FOLDER] [--json FILE]

Each core works alone on its own clips; processor time is what a clip costs on an idle core, whatever else runs here.
"""

import argparse
import multiprocessing as mp
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.speed.results import write_results
from wm_nodes.apps.options import add_device, add_json, positive
from wm_nodes.core.allocator import keep_freed_memory
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.backends.embedded import shipped_head
from wm_nodes.judge.evidence.clip import clip_evidence
from wm_nodes.judge.evidence.head import load_head
from wm_nodes.reports.machine import machine_facts

SIDE_PX, FRAMES = 96, 25
INSTRUCTION = "push the blue cube into the red target"


def moving_clip(seed: int) -> UInt8Array:
    """A textured table with a red disc, over which a blue square and a grey column move; uint8 (T, H, W, 3)."""
    rng = numpy_stream(seed, "judge_speed")
    table = cv2.GaussianBlur(rng.uniform(120, 220, (SIDE_PX, SIDE_PX, 3)).astype(np.float32), (0, 0), 2.0)
    cv2.circle(table, (64, 60), 16, (210, 40, 40), -1)
    frames = np.repeat(table[None], FRAMES, 0)
    for t, frame in enumerate(frames):
        cv2.rectangle(frame, (20 + t, 50), (30 + t, 60), (30, 60, 210), -1)
        cv2.rectangle(frame, (10 + t, 0), (18 + t, 56), (190, 190, 195), -1)
    return frames.astype(np.uint8)


def read_clips(folder: Path, count: int, seed: int, device: str = CPU) -> tuple[float, float]:
    """Processor and wall seconds per clip of evidence and every head, on one thread."""
    keep_freed_memory()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    head, clip = load_head(folder, compute_device(device)), moving_clip(seed)
    started = [0.0, 0.0]
    for index in range(count + 1):
        if index == 1:  # the first one pays for what is loaded late
            started = [time.process_time(), time.monotonic()]
        row = head.row(clip_evidence(head.segmenter, clip, clip[0], INSTRUCTION, head.readers))
        head.familiarity.distance(row)
        for target in head.questions:
            head.levels(target, row)
    return (time.process_time() - started[0]) / count, (time.monotonic() - started[1]) / count


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, nargs="?", default=shipped_head(), help="a trained judge; the shipped one")
    parser.add_argument("--cores", type=positive, default=2)
    parser.add_argument("--clips", type=positive, default=40, help="per core")
    add_device(parser, CPU)
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    """Measure, write --json and print."""
    with ProcessPoolExecutor(arguments.cores, mp_context=mp.get_context("spawn")) as pool:
        jobs = [
            pool.submit(read_clips, arguments.folder, arguments.clips, seed, arguments.device)
            for seed in range(arguments.cores)
        ]
        seconds = [job.result() for job in jobs]
    processor_s, wall_s = (float(np.mean(column)) for column in zip(*seconds))
    clips_per_s, clips_per_s_now = arguments.cores / processor_s, arguments.cores / wall_s
    write_results(arguments, {
        "judge": load_head(arguments.folder).sha256, "frames": FRAMES, "side_px": SIDE_PX,
        "processes": arguments.cores, "clips_each": arguments.clips, "processor_s_per_clip": processor_s,
        "wall_s_per_clip": wall_s, "clips_per_s": clips_per_s, "clips_per_s_by_the_clock": clips_per_s_now,
    }, exact=True)
    facts = machine_facts(arguments.device)
    print(f"{FRAMES} frames of {SIDE_PX} px on {arguments.cores} processes, {facts['processor']}, {facts['date']}")
    print(f"processor {1000 * processor_s:.1f} ms a clip: {clips_per_s:.1f} clips/s on idle cores")
    print(f"wall      {1000 * wall_s:.1f} ms a clip: {clips_per_s_now:.1f} clips/s now")
