"""Loop 2 as a job: bags in, a video model, GRPO over the graph, held-out scores before and after, a report.

Resumable: collected bags, the trained model, finished evaluations and the learner's checkpoint stay in the run folder.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table
from tqdm import tqdm

from wm_nodes.config.load import ConfigError, load_config, parse_override
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.job import READY_S, Stages, console, open_run_dir
from wm_nodes.learning.clip_generation import ClipGenerator
from wm_nodes.learning.clip_scores import score_clips
from wm_nodes.learning.collecting import HELDOUT_SEEDS, TRAINING_SEEDS, collect_plan, scripted_plan
from wm_nodes.learning.files import write_atomic
from wm_nodes.learning.statistics import bootstrap_mean
from wm_nodes.learning.video_config import VideoRlConfig, dump_video_config, load_video_config, video_preset_names
from wm_nodes.learning.video_data import Clips, load_clips
from wm_nodes.learning.video_folder import VideoFolder, load_video_folder
from wm_nodes.learning.video_pretraining import make_video_model
from wm_nodes.learning.video_run import version_uri
from wm_nodes.learning.weights import load_weights, pack_weights
from wm_nodes.reports import machine_facts
from wm_nodes.reports.film_strip import film_strip
from wm_nodes.reports.summary import plain
from wm_nodes.ros import arguments as launch_arguments
from wm_nodes.ros.domain import DomainInUseError
from wm_nodes.ros.graph import GraphError
from wm_nodes.ros.operator import GoalFailed, Operator, PeerLost
from wm_nodes.ros.readiness import NotReadyError
from wm_nodes.ros.runner import NodeDiedError, Runner
from wm_nodes.world_model import load_model_folder
from wm_nodes.world_model.position_probe import PositionProbe

EXPECTED = (
    ConfigError, DomainInUseError, GraphError, NodeDiedError, NotReadyError, GoalFailed, PeerLost, ValueError, OSError,
)  # fmt: skip
HELDOUT_EPISODES = 100
STRIPS = 3
SHOWN = {
    "tracking": "tracking score", "object_cm": "object error, cm", "tool_cm": "tool error, cm", "psnr_db": "PSNR, dB",
    "scenery": "scenery error", "motion": "motion share",
}  # fmt: skip


def main(argv: Sequence[str]) -> int:
    """Return the exit code: 0 done, 2 a clear error, 130 interrupted (start again with --run-dir to go on)."""
    arguments = _parser().parse_args(argv)
    try:
        run(arguments)
    except KeyboardInterrupt:
        console.print("interrupted; --run-dir goes on from here", highlight=False)
        return 130
    except EXPECTED as error:
        console.print(f"[bold red]error:[/] {error}", highlight=False)
        return 2
    return 0


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """The whole job; see main. Returns what summary.json holds."""
    stage = Stages()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    config, run_dir = _open_run(arguments)
    stage(f"run folder {run_dir}")
    scene = load_config("cpu", {"task": config.task, "seed": config.seed})
    probe = load_model_folder(Path(shipped_model(config.task))).probe
    if probe is None:
        raise ValueError(f"the world model of {config.task} has no position probe to judge with")
    bags, heldout = _data(config, scene, run_dir, stage)
    stage("video model: codec and flow matching")
    clips = load_clips(bags, config.model.stride)
    folder = make_video_model(config, clips, heldout, probe, run_dir, command=_command())
    before = measured(config, folder, heldout, probe, run_dir, "before")
    version, bag = _post_train(arguments, config, bags, run_dir, stage)
    trained = load_video_folder(run_dir / "video_model")
    load_weights(trained.network, (run_dir / version_uri(version)).read_bytes())
    after = measured(config, trained, heldout, probe, run_dir, "after")
    summary = plain({
        "task": config.task, "preset": arguments.preset, "seed": config.seed, "iterations": config.iterations,
        "version": version, "contexts": config.evaluation.contexts,
        "scores": {name: _change(before[name], after[name], config.seed) for name in SHOWN},
        "bag": str(bag), "minutes": stage.minutes, "command": _command(), "machine": machine_facts(),
        "date": time.strftime("%Y-%m-%d"),
    })  # fmt: skip
    write_atomic(run_dir / "summary.json", (json.dumps(summary, indent=1) + "\n").encode())
    strips = _pictures(config, load_video_folder(run_dir / "video_model"), trained, heldout, run_dir)
    console.print(_table(summary))
    console.print(f"strips   {strips}\nsummary  {run_dir / 'summary.json'}\nbag      {bag}", highlight=False)
    return dict(summary)


def measured(
    config: VideoRlConfig, folder: VideoFolder, heldout: Clips, probe: PositionProbe, run_dir: Path, label: str
) -> dict[str, list[float]]:
    """Scores of held-out contexts, one ODE clip each, by name; kept for the same weights."""
    path, sha = run_dir / "evaluations" / f"{label}.json", _weights_sha(folder)
    if path.is_file() and (kept := json.loads(path.read_text()))["sha256"] == sha:
        return dict(kept["scores"])
    some = heldout.select(torch.arange(min(config.evaluation.contexts, len(heldout))))
    frames = ClipGenerator(folder, some, config).evaluate(some, config.evaluation.num_steps)
    found = score_clips(frames, some, probe, folder.clip["num_conditioning"]).named()
    scores = {name: values.tolist() for name, values in found.items()}
    write_atomic(path, json.dumps({"sha256": sha, "scores": scores}).encode())
    return scores


def _data(config: VideoRlConfig, scene: RunConfig, run_dir: Path, stage: Stages) -> tuple[list[Path], Clips]:
    stage(f"{config.data_episodes} + {min(HELDOUT_EPISODES, config.data_episodes)} held-out simulator episodes")
    train = scripted_plan(scene, config.data_episodes, TRAINING_SEEDS)
    held = scripted_plan(scene, min(HELDOUT_EPISODES, config.data_episodes), HELDOUT_SEEDS)
    bags = collect_plan(train, scene, run_dir / "data" / "train")
    heldout = collect_plan(held, scene, run_dir / "data" / "heldout")
    return bags, load_clips(heldout, config.model.stride)


def _post_train(
    arguments: argparse.Namespace, config: VideoRlConfig, bags: list[Path], run_dir: Path, stage: Stages
) -> tuple[int, Path]:
    """GRPO over the graph; returns the last version and the bag."""
    progress = run_dir / "trained.json"
    if progress.is_file():
        kept = json.loads(progress.read_text())
        return int(kept["version"]), Path(kept["bag"])
    bag = run_dir / "bags" / f"world_model_rl_{time.strftime('%H%M%S')}"
    graph, _ = launch_arguments.prepare("world_model_rl", {
        "config_file": str(run_dir / "config.yaml"), "run_dir": str(run_dir), "bag_uri": str(bag),
        "video_model_dir": str(run_dir / "video_model"), "context_bags": ",".join(map(str, bags)),
        "domain_id": arguments.domain_id,
    })  # fmt: skip
    stage("starting the graph: " + ", ".join(node.label for node in graph.nodes))
    with Runner(graph, log_dir=run_dir / "logs", log=sys.stdout if arguments.verbose else None) as runner:
        runner.wait_ready(READY_S)
        os.environ.update(runner.environment)
        with Operator(alive=runner.check) as operator, tqdm(total=config.iterations, desc="GRPO", unit="buffer") as bar:
            done = _iterations_done(run_dir)
            bar.update(done)

            def show(feedback: Any) -> None:
                bar.update(done + feedback.iteration - bar.n)
                bar.set_postfix(reward=f"{feedback.reward_mean:.3f}", kl=f"{feedback.kl:.1e}")

            left = config.iterations - done
            version = operator.train_video(left, show) if left > 0 else _last_version(run_dir)
    write_atomic(progress, json.dumps({"version": version, "bag": str(bag)}).encode())
    return version, bag


def _iterations_done(run_dir: Path) -> int:
    path = run_dir / "metrics.jsonl"
    return sum(json.loads(line)["section"] == "grpo" for line in path.read_text().splitlines()) if path.is_file() else 0


def _last_version(run_dir: Path) -> int:
    return max(int(path.stem.split("_")[1]) for path in (run_dir / "video_policies").glob("video_*.safetensors"))


def _pictures(config: VideoRlConfig, base: VideoFolder, trained: VideoFolder, heldout: Clips, run_dir: Path) -> Path:
    """Film strips: the recording, the base model, the trained model."""
    some = heldout.select(torch.arange(min(STRIPS, len(heldout))))
    rows = {
        "recorded": some.frames,
        "before": ClipGenerator(base, some, config).evaluate(some, config.evaluation.num_steps),
        "after": ClipGenerator(trained, some, config).evaluate(some, config.evaluation.num_steps),
    }
    for index in range(len(some)):
        pictures = {label: np.ascontiguousarray(frames[index].numpy()) for label, frames in rows.items()}
        film_strip(pictures, path=run_dir / "strips" / f"strip_{index}.png")
    return run_dir / "strips"


def _change(before: Sequence[float], after: Sequence[float], seed: int) -> dict[str, float]:
    mean, low, high = bootstrap_mean(np.subtract(after, before), seed=seed)
    return {
        "before": float(np.mean(before)), "after": float(np.mean(after)), "difference": mean, "low": low, "high": high,
    }  # fmt: skip


def _weights_sha(folder: VideoFolder) -> str:
    return pack_weights(folder.network).sha256


def _table(summary: Any) -> Table:
    table = Table(title=f"held-out contexts (n = {summary['contexts']}), one ODE clip each")
    for name in ("score", "before", "after", "difference, 95 % bootstrap interval"):
        table.add_column(name, justify="left" if name == "score" else "right")
    for name, title in SHOWN.items():
        row = summary["scores"][name]
        difference = f"{row['difference']:+.4f} ({row['low']:+.4f} to {row['high']:+.4f})"
        table.add_row(title, f"{row['before']:.4f}", f"{row['after']:.4f}", difference)
    return table


def _open_run(arguments: argparse.Namespace) -> tuple[VideoRlConfig, Path]:
    overrides: dict[str, Any] = dict(parse_override(text) for text in arguments.set)
    if arguments.seed is not None:
        overrides["seed"] = arguments.seed
    config = load_video_config(arguments.preset, overrides)
    return config, open_run_dir(arguments.run_dir, "world_model_rl", dump_video_config(config))


def _command() -> str:
    return "python3 launch_scripts/world_model_rl.py " + " ".join(sys.argv[1:])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="world_model_rl.py",
        description="Post-train a flow-matching video world model by DynDiff-GRPO, as a ROS 2 graph, and measure it on "
        "held-out contexts before and after.",
    )
    parser.add_argument("--preset", default="recommended", help=f"one of {', '.join(video_preset_names())}, or a .yaml")
    parser.add_argument("--seed", type=int, help="root seed of every random number; default: the preset's")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one setting")
    parser.add_argument("--run-dir", type=Path, help="run folder; an existing one is resumed. Default: runs/<time>-...")
    parser.add_argument("--domain-id", default="", help="ROS domain 0 to 101; default: $ROS_DOMAIN_ID, else 0")
    parser.add_argument("--verbose", action="store_true", help="show the nodes' logs (they are in <run>/logs anyway)")
    return parser
