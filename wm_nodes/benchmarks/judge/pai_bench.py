"""PAI-Bench's robot protocol over a folder of videos: domain questions through a chat server, consistency metrics from
local backbones. What is public of the protocol and what is inferred: comparisons/pai_bench.py.

    wm benchmark judge pai-bench VIDEOS --questions FOLDER --url http://127.0.0.1:8000/v1 --model NAME
        --subject FOLDER --background FOLDER --images FOLDER --metrics others.json

VIDEOS holds <video_id>.mp4; --images <video_id>.png or .jpg, the conditioning images. --subject and --background are
folders of vision models (DINO and CLIP's vision model in the published metric). --metrics gives those of the eight
metrics that need networks which are not here, in percent: {"aesthetic_quality": 48.0, ...}. Nothing is downloaded.
"""

import argparse
import asyncio
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.judge.comparisons import pai_bench as pai
from benchmarks.judge.comparisons.chat import ChatComparison
from benchmarks.speed.results import write_results
from wm_nodes.apps.options import add_json, add_seed
from wm_nodes.core.progress import tqdm
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.types import ClipRef
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint
from wm_nodes.judge.clip_files import read_picture, read_video
from wm_nodes.video_rl.frame_features import FrameFeatures, load_backbone

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
BACKBONE_METRICS = {"subject": ("subject_consistency", "i2v_subject"),
                    "background": ("background_consistency", "i2v_background")}
"""By the option that names the backbone: the metric of the video alone, and the one with its conditioning image."""


def metrics_of(clip: ClipRef, image: UInt8Array | None, backbones: dict[str, FrameFeatures]) -> dict[str, float]:
    """The metrics that these backbones give, percent; those with the conditioning image only where there is one."""
    metrics = {}
    for kind, features in backbones.items():
        alone, with_image = BACKBONE_METRICS[kind]
        rows = features(torch.from_numpy(np.ascontiguousarray(clip.frames))).numpy()
        metrics[alone] = 100 * pai.consistency(rows)
        if image is not None:
            first = features(torch.from_numpy(np.ascontiguousarray(image))[None]).numpy()[0]
            metrics[with_image] = 100 * pai.image_consistency(rows, first)
    return metrics


def quality(videos: Sequence[Path], images: Path | None, backbones: dict[str, FrameFeatures]) -> dict[str, float]:
    """Means over the videos. Raises ValueError: a video or its conditioning image is missing or unreadable."""
    rows = [metrics_of(read_video(path), _image(images, path.stem), backbones) for path in tqdm(videos, "quality")]
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]} if backbones else {}


async def domain(arguments: argparse.Namespace, videos: Sequence[Path]) -> tuple[float, int, int]:
    """Accuracy in percent, questions that were answered, and questions that were not.

    Raises:
        ValueError: no question is about one of these videos, or not one was answered.
    """
    by_name = {path.stem: path for path in videos}
    asked = [question for question in pai.load_questions(arguments.questions) if question.video_id in by_name]
    if not asked:
        raise ValueError(f"no question of {arguments.questions} is about a video of {arguments.videos}")
    transport = ChatTransport([Endpoint(url, arguments.model, arguments.api_key_env) for url in arguments.url])
    answers: list[pai.AnsweredQuestion] = []
    try:
        judge, clip = ChatComparison(transport, seed=arguments.seed), None
        for question in tqdm(asked, "domain"):
            if clip is None or clip.clip_id != question.video_id:
                clip = read_video(by_name[question.video_id])
            answers.append(await pai.answer(judge, question, clip))
    finally:
        await transport.close()
    score, unanswered = pai.domain_score(answers)
    return score, len(answers) - unanswered, unanswered


def _image(folder: Path | None, name: str) -> UInt8Array | None:
    if folder is None:
        return None
    path = next((path for suffix in IMAGE_SUFFIXES if (path := folder / f"{name}{suffix}").is_file()), None)
    if path is None:
        raise ValueError(f"{folder} has no readable {name}{'|'.join(IMAGE_SUFFIXES)}; every video needs its image")
    return read_picture(path)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("videos", type=Path, help="folder of <video_id>.mp4")
    parser.add_argument("--questions", type=Path, help="the vqa folder of physical-ai-bench-predict")
    parser.add_argument("--url", nargs="+", default=[], help="of chat servers, http://HOST:PORT/v1")
    parser.add_argument("--model", default="", help="that they serve")
    parser.add_argument("--api-key-env", default="", help="environment variable that holds their key")
    parser.add_argument("--subject", type=Path, help="folder of a vision model, e.g. DINO")
    parser.add_argument("--background", type=Path, help="folder of a vision model, e.g. CLIP's")
    parser.add_argument("--images", type=Path, help="folder of the conditioning images")
    parser.add_argument("--metrics", type=Path, help="JSON of the metrics that were measured elsewhere, percent")
    add_seed(parser)
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    """Print and write what could be measured."""
    results = _measure(arguments)
    for name, value in results["scores"].items():
        print(f"{name:24} {value:7.2f}")
    if "answered" in results:
        print(f"questions answered: {results['answered']}, not answered and left out: {results['unanswered']}")
    if results["missing"]:
        print(f"no Quality and no Overall: {', '.join(results['missing'])} not given")
    write_results(arguments, results, exact=True)


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    videos = sorted(arguments.videos.glob("*.mp4"))
    if not videos:
        raise ValueError(f"{arguments.videos} holds no .mp4")
    if bool(arguments.questions) != bool(arguments.url) or bool(arguments.url) != bool(arguments.model):
        raise ValueError("the domain questions need --questions FOLDER, --url and --model together")
    folders = {kind: getattr(arguments, kind) for kind in BACKBONE_METRICS if getattr(arguments, kind)}
    backbones: dict[str, FrameFeatures] = {kind: load_backbone(folder) for kind, folder in folders.items()}
    if not backbones and not arguments.questions:
        raise ValueError("nothing to measure: give --questions with a server, --subject or --background")
    metrics = quality(videos, arguments.images, backbones)
    if arguments.metrics is not None:
        metrics |= {name: float(value) for name, value in json.loads(arguments.metrics.read_bytes()).items()}
    results: dict[str, Any] = {
        "videos": len(videos), "model": arguments.model, "backbones": {k: b.name for k, b in backbones.items()},
        "scores": dict(metrics), "missing": sorted(set(pai.QUALITY) - set(metrics)),
    }
    score = math.nan
    if arguments.questions:
        score, results["answered"], results["unanswered"] = asyncio.run(domain(arguments, videos))
        results["scores"]["domain"] = score
    if arguments.questions and not results["missing"]:
        results["scores"] |= pai.summary(score, metrics)
    return results
