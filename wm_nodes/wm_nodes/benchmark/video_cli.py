"""DynDiff-GRPO against its rivals on the moving disc: claims A (diversity), B (learning) and C (cost of the KL)."""

import argparse
import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from wm_nodes.benchmark.moving_disc import CHANNELS, NUM_ACTIONS, training_batch
from wm_nodes.benchmark.video_arms import Arm, diversity_arms, learning_arms
from wm_nodes.benchmark.video_cost import measure_anchors, measure_rollout
from wm_nodes.benchmark.video_diversity import DiversityPlan, compare, measure_arm
from wm_nodes.benchmark.video_learning import LearningPlan, train_arm
from wm_nodes.learning.files import write_atomic
from wm_nodes.learning.statistics import bootstrap_mean
from wm_nodes.learning.video_grpo import GrpoSettings
from wm_nodes.learning.video_training import FlowMatchingSettings, train_video_model
from wm_nodes.learning.weights import pack_weights, unpack_weights
from wm_nodes.reports import machine_facts
from wm_nodes.video_model import NetworkSettings, VideoNetwork

BASE_ITERATIONS, BASE_BATCH = 4000, 16
NETWORK = NetworkSettings(channels=CHANNELS, action_dim=NUM_ACTIONS, width=32, depth=5)
LEARNER = GrpoSettings(learning_rate=1e-4, micro_batch=64)
"""Table 5's clip, advantage clip, KL and step fraction; a learning rate for 76 k parameters instead of billions."""
console = Console()


def main(argv: Sequence[str]) -> int:
    """Return the exit code: 0 done, 2 a clear error, 130 interrupted (finished rows are kept)."""
    arguments = _parser().parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    try:
        {"base": _base, "diversity": _diversity, "learning": _learning, "cost": _cost}[arguments.claim](arguments)
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError) as error:
        console.print(f"[bold red]error:[/] {error}", highlight=False, soft_wrap=True)
        return 2
    return 0


def load_base(path: Path | None = None) -> VideoNetwork:
    """The base model: the one at `path`, or the shipped one."""
    shipped = resources.files("wm_nodes") / "pretrained" / "moving_disc" / "video_model.safetensors"
    data = path.read_bytes() if path is not None else shipped.read_bytes()
    model = VideoNetwork(NETWORK)
    tensors, _ = unpack_weights(data)
    model.load_state_dict(tensors)
    return model.eval()


def _base(arguments: argparse.Namespace) -> None:
    torch.manual_seed(arguments.seed)
    model = VideoNetwork(NETWORK)
    train_video_model(
        model, lambda iteration: training_batch(BASE_BATCH, arguments.seed, iteration),
        FlowMatchingSettings(arguments.iterations), seed=arguments.seed, run_dir=arguments.out,
    )  # fmt: skip
    command = f"benchmark_dyndiff.py base --seed {arguments.seed} --iterations {arguments.iterations}"
    path = arguments.out / "video_model.safetensors"
    write_atomic(path, pack_weights(model, {"command": command}).data)
    console.print(f"written {path}", highlight=False)


def _diversity(arguments: argparse.Namespace) -> None:
    model, plan = load_base(arguments.base), DiversityPlan(arguments.contexts, arguments.group_size)
    rows, comparisons = list[dict[str, Any]](), list[dict[str, Any]]()
    arms = _named(diversity_arms(), arguments.arms)
    with tqdm(total=2 * len(arms), desc="diversity", unit="arm") as bar:
        for shared in (False, True):
            regime = {}
            for arm in arms:
                regime[arm.name] = measure_arm(model, replace(arm, shared_noise=shared), plan, arguments.seed)
                rows.append(regime[arm.name])
                bar.update()
            bases = [name for name in regime if name.startswith("CPS")]
            comparisons += [
                compare(row, regime[base], arguments.seed)
                for name, row in regime.items() if name.startswith("DynDiff") for base in bases
            ]  # fmt: skip
    _write(arguments, {"plan": asdict(plan), "rows": rows, "comparisons": comparisons})
    _show_diversity(rows, arguments.seed)


def _learning(arguments: argparse.Namespace) -> None:
    plan = LearningPlan(iterations=arguments.iterations, scenes=arguments.scenes, hackable=arguments.hackable)
    arms = _named(learning_arms(LEARNER), arguments.arms)
    rows = _finished(arguments.json)
    wanted = [(arm, seed) for seed in arguments.seeds for arm in arms]
    todo = [(arm, seed) for arm, seed in wanted if (arm.name, seed) not in {(row["arm"], row["seed"]) for row in rows}]
    with tqdm(total=len(todo) * plan.iterations, desc="learning", unit="buffer") as bar:
        for arm, seed in todo:
            bar.set_postfix_str(f"{arm.name}, seed {seed}")
            rows.append(train_arm(load_base(arguments.base), arm, plan, seed, on_iteration=bar.update))
            _write(arguments, {"plan": asdict(plan), "learner": asdict(LEARNER), "rows": rows})
    _show_learning(rows)


def _cost(arguments: argparse.Namespace) -> None:
    model = load_base(arguments.base)
    rollout = measure_rollout(model, arguments.repeats, arguments.seed)
    rows = measure_anchors(model, LEARNER, arguments.repeats, arguments.seed)
    _write(arguments, {"rollout": rollout, "rows": rows})
    table = Table(title=f"KL anchors, median of {arguments.repeats} turns on one buffer")
    for name in ("anchor", "training, s", "of which KL, s", "kept beside the weights, MiB"):
        table.add_column(name, justify="left" if name == "anchor" else "right")
    for row in rows:
        table.add_row(row["anchor"], f"{row['train_s']:.3f}", f"{row['kl_s']:.3f}", f"{row['bytes'] / 2**20:.2f}")
    console.print(table)
    console.print(f"sampling with the mask / without: {rollout['dyndiff_over_cps']:.3f}", highlight=False)


def _named(arms: list[Arm], names: list[str] | None) -> list[Arm]:
    known = {arm.name: arm for arm in arms}
    unknown = [name for name in names or [] if name not in known]
    if unknown:
        raise ValueError(f"unknown arms {', '.join(unknown)}; choose among: {'; '.join(known)}")
    return [known[name] for name in names] if names else arms


def _finished(path: Path | None) -> list[dict[str, Any]]:
    if path is None or not path.is_file():
        return []
    rows: list[dict[str, Any]] = json.loads(path.read_text())["rows"]
    return rows


def _write(arguments: argparse.Namespace, found: dict[str, Any]) -> None:
    if arguments.json is None:
        return
    facts = {"machine": machine_facts(), "date": time.strftime("%Y-%m-%d"), "seed": arguments.seed}
    write_atomic(arguments.json, (json.dumps({**found, **facts}) + "\n").encode())


def _show_diversity(rows: list[dict[str, Any]], seed: int) -> None:
    table = Table(title="diversity (19) and quality, mean over contexts with 95 % bootstrap interval")
    columns = ("arm", "initial noise", "noise rms/s", "diversity", "moving part", "reward std", "reward", "bg", "mass")
    for name in columns:
        table.add_column(name, justify="left" if name in ("arm", "initial noise") else "right")
    for row in rows:
        mean, low, high = bootstrap_mean(row["diversity"], seed=seed)
        shown = ("diversity_dynamic", "reward_std", "reward", "background", "mass")
        values = [sum(row[name]) / len(row[name]) for name in shown]
        table.add_row(
            row["arm"], "shared" if row["shared_noise"] else "own", f"{row['noise_share']:.3f}",
            f"{mean:.3f} ({low:.3f} to {high:.3f})", *(f"{value:.4f}" for value in values),
        )  # fmt: skip
    console.print(table)


def _show_learning(rows: list[dict[str, Any]]) -> None:
    table = Table(title="held-out scenes, ODE, before and after")
    shown = ("arm", "seed", "reward", "obeyed", "bg", "mass", "noise", "clipped low/high @2", "falling", "seconds")
    for name in shown:
        table.add_column(name, justify="left" if name == "arm" else "right")
    for row in sorted(rows, key=lambda row: (row["arm"], row["seed"])):
        first, last = row["evaluations"][0], row["evaluations"][-1]
        update = row["buffers"][-1]["updates"][-1]
        table.add_row(
            row["arm"], str(row["seed"]), *(f"{first[name]:.3f} -> {last[name]:.3f}" for name in ("reward", "obeyed")),
            f"{last['background']:.4f}", f"{last['mass']:.3f}", f"{row['buffers'][-1]['noise_share']:.3f}",
            f"{update['clip_low_share']:.2f}/{update['clip_high_share']:.2f}", ", ".join(row["hacked"]),
            f"{sum(row['seconds'].values()):.0f}",
        )  # fmt: skip
    console.print(table)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmark_dyndiff.py", description=__doc__)
    claims = parser.add_subparsers(dest="claim", required=True)
    base = claims.add_parser("base", help="train the base model (minutes on one core)")
    base.add_argument("--iterations", type=int, default=BASE_ITERATIONS)
    base.add_argument("--out", type=Path, default=Path("runs/moving_disc"))
    diversity = claims.add_parser("diversity", help="claim A: diversity at equal quality and noise budget")
    diversity.add_argument("--contexts", type=int, default=100)
    diversity.add_argument("--group-size", type=int, default=8)
    learning = claims.add_parser("learning", help="claim B: reward against model calls, every arm on one learner")
    learning.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    learning.add_argument("--iterations", type=int, default=40)
    learning.add_argument("--scenes", type=int, default=6, help="contexts per iteration, 8 videos each")
    learning.add_argument("--hackable", action="store_true", help="reward the task alone, to see the detector fire")
    cost = claims.add_parser("cost", help="claim C: seconds and bytes of the KL anchors, and of the mask")
    cost.add_argument("--repeats", type=int, default=7)
    for claim in (base, diversity, learning, cost):
        claim.add_argument("--seed", type=int, default=0)
    for claim in (diversity, learning):
        claim.add_argument("--arms", nargs="+", metavar="NAME")
    for claim in (diversity, learning, cost):
        claim.add_argument("--base", type=Path, help="weights of another base model than the shipped one")
        claim.add_argument("--json", type=Path, help="write every row here; `learning` goes on where the file stops")
    return parser
