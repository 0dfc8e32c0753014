"""The main job: collect, judge the world model, clone a weak policy, train it in the world model, measure it for real.

Every stage leaves its files in the run folder and is skipped when they are there, so a run can be resumed by naming it.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from tqdm import tqdm

from wm_nodes.config.load import ConfigError, dump_config, load_config, parse_override, preset_names
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.learning.collecting import (
    HELDOUT_SEEDS,
    collect_plan,
    scripted_plan,
)
from wm_nodes.learning.evaluation import EvaluationResult, evaluate
from wm_nodes.learning.gate import GateReport, judge_model
from wm_nodes.learning.pictures import write_pictures
from wm_nodes.learning.policies import load_policy, make_imagined_environment
from wm_nodes.learning.preparation import prepare_start
from wm_nodes.learning.pretraining import load_arrays, make_model
from wm_nodes.learning.statistics import paired_difference, wilson_interval
from wm_nodes.reports import Rate, Summary, machine_facts, results_table, write_report, write_summary
from wm_nodes.ros import arguments as launch_arguments
from wm_nodes.ros.domain import DomainInUseError
from wm_nodes.ros.graph import GraphError
from wm_nodes.ros.operator import Evaluation, GoalFailed, Operator, PeerLost
from wm_nodes.ros.readiness import NotReadyError
from wm_nodes.ros.runner import NodeDiedError, Runner
from wm_nodes.types import BoolArray
from wm_nodes.world_model import load_model_folder

DEMONSTRATION_SEEDS = 600_000
START_SEEDS = 700_000
NUM_STARTS = 256
IMAGINED_EPISODES = 256
READY_S = 120.0

EXPECTED = (
    ConfigError, GraphError, DomainInUseError, NodeDiedError, NotReadyError, GoalFailed, PeerLost, ValueError, OSError,
)  # fmt: skip
"""Errors whose text says what to do; anything else is a fault of ours and shows its traceback."""

console = Console()


class GateRefused(RuntimeError):
    """The world model does not deserve to be trained in."""


def main(argv: Sequence[str]) -> int:
    """Return the exit code: 0 done, 2 a clear error, 3 the gate refused the model, 130 Ctrl-C."""
    arguments = _parser().parse_args(argv)
    try:
        run(arguments)
    except GateRefused as refusal:
        console.print(f"[bold red]gate:[/] {refusal}")
        return 3
    except KeyboardInterrupt:
        console.print("stopped; name the run folder with --run-dir to go on")
        return 130
    except EXPECTED as error:
        console.print(f"[bold red]error:[/] {error}", highlight=False)
        return 2
    return 0


def run(arguments: argparse.Namespace) -> Summary:
    """The whole job; see main."""
    started = time.monotonic()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    config, run_dir = _open_run(arguments)
    stage = _Stages(started)
    stage(f"run folder {run_dir}")
    model_dir = _model(arguments, config, run_dir, stage)
    stage(f"{config.sft.num_demonstrations} MPLib demonstrations, first frames, and the weak policy cloned from them")
    starts, weak = prepare_start(config, run_dir, model_dir)
    imagined_before = _imagine(config, model_dir, starts, weak, stage)
    graph, _ = launch_arguments.prepare("online_training", {
        "config_file": str(run_dir / "config.yaml"), "run_dir": str(run_dir), "model_dir": str(model_dir),
        "starts_file": str(starts), "initial_policy": str(weak), "seed": str(config.seed),
        "bag_uri": str(run_dir / "bags" / f"training_{time.strftime('%H%M%S')}"), "domain_id": arguments.domain_id,
        "compose": "true" if arguments.compose else "false",
    })  # fmt: skip
    stage("starting the graph: " + ", ".join(node.label for node in graph.nodes))
    with Runner(graph, log_dir=run_dir / "logs", log=sys.stdout if arguments.verbose else None) as runner:
        runner.wait_ready(READY_S)
        with _operator(runner) as operator:
            real_before = _evaluate(operator, config, "before", stage)
            gate = _judge(config, run_dir, model_dir, imagined_before, real_before.success, arguments.force, stage)
            stage(f"training the policy in the world model: {config.ppo.updates} updates")
            training_started = time.monotonic()
            trained = _train(operator, config.ppo.updates)
            training_s = time.monotonic() - training_started
            real_after = _evaluate(operator, config, "after", stage)
    final = run_dir / "policies" / f"policy_{trained.policy_version:06d}.safetensors"
    imagined_after = _imagine(config, model_dir, starts, final, stage)
    summary = Summary(
        task=config.task, preset=arguments.preset, seed=config.seed,
        real_before=_rate(real_before.success), real_after=_rate(real_after.success),
        imagined_before=_rate(imagined_before.success), imagined_after=_rate(imagined_after.success),
        imagined_steps_per_s=trained.samples / training_s if training_s else 0.0,
        bag=str(next(iter(sorted((run_dir / "bags").glob("training*"))), "")),
        paired=asdict(paired_difference(real_before.success.tolist(), real_after.success.tolist())),
        imagined_paired=asdict(paired_difference(imagined_before.success.tolist(), imagined_after.success.tolist())),
        gate=gate.to_dict(), samples=trained.samples, minutes=(time.monotonic() - started) / 60,
        command=_command(), machine=machine_facts(),
    )  # fmt: skip
    write_summary(run_dir, summary)
    pictures = write_pictures(run_dir, config, model_dir, load_policy(config, model_dir, final), HELDOUT_SEEDS)
    report = write_report(run_dir, summary, pictures, config_text=dump_config(config))
    console.print(results_table(summary))
    console.print(f"report   {report}\nsummary  {run_dir / 'summary.json'}\nbag      {summary.bag}", highlight=False)
    return summary


def _command() -> str:
    return "python3 launch_scripts/online_rl.py " + " ".join(sys.argv[1:])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="online_rl.py",
        description="Train a robot policy by RL inside a learned world model, as a ROS 2 graph, and measure it in the "
        "real simulator before and after.",
    )
    parser.add_argument("--preset", default="cpu", help=f"one of {', '.join(preset_names())}, or a .yaml of overrides")
    parser.add_argument("--task", choices=("reach", "push_cube", "pull_cube"), help="default: the preset's")
    parser.add_argument("--seed", type=int, help="root seed of every random number; default: the preset's")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one setting")
    parser.add_argument(
        "--run-dir", type=Path, help="run folder; an existing one is resumed. Default: runs/<time>-<task>"
    )
    parser.add_argument("--model-dir", type=Path, help="world model to use instead of the shipped one")
    parser.add_argument("--from-scratch", action="store_true", help="collect data and train the world model too")
    parser.add_argument("--force", action="store_true", help="train even in a model that fails the gate")
    parser.add_argument("--compose", action="store_true", help="all nodes in one process")
    parser.add_argument("--domain-id", default="", help="ROS domain 0 to 101; default: $ROS_DOMAIN_ID, else 0")
    parser.add_argument("--verbose", action="store_true", help="show the nodes' logs (they are in <run>/logs anyway)")
    return parser


def _open_run(arguments: argparse.Namespace) -> tuple[RunConfig, Path]:
    overrides: dict[str, Any] = dict(parse_override(text) for text in arguments.set)
    if arguments.task:
        overrides["task"] = arguments.task
    if arguments.seed is not None:
        overrides["seed"] = arguments.seed
    config = load_config(arguments.preset, overrides)
    name = f"{time.strftime('%Y%m%d-%H%M%S')}-{config.task}"
    run_dir = (arguments.run_dir or Path("runs") / name).expanduser().absolute()
    run_dir.mkdir(parents=True, exist_ok=True)
    saved = run_dir / "config.yaml"
    if saved.exists() and saved.read_text() != dump_config(config):
        raise ConfigError(f"{run_dir} was begun with another configuration ({saved}); use its settings or a new folder")
    saved.write_text(dump_config(config))
    return config, run_dir


class _Stages:
    """Prints what is being done, with the minutes since the start."""

    def __init__(self, started: float) -> None:
        self._started = started

    def __call__(self, text: str) -> None:
        minutes, seconds = divmod(int(time.monotonic() - self._started), 60)
        console.print(f"[dim]{minutes:3d}:{seconds:02d}[/] {text}", highlight=False)


def _model(arguments: argparse.Namespace, config: RunConfig, run_dir: Path, stage: _Stages) -> Path:
    if arguments.from_scratch:
        stage(f"world model from scratch: {config.data.num_episodes} simulator episodes, tokenizer, dynamics")
        return make_model(config, run_dir, command=_command())
    model_dir = arguments.model_dir or shipped_model(config.task)
    stage(f"world model {model_dir}")
    return Path(model_dir).expanduser().absolute()


def _imagine(config: RunConfig, model_dir: Path, starts: Path, policy: Path, stage: _Stages) -> EvaluationResult:
    """Success in the world model, without action noise, on IMAGINED_EPISODES starts."""
    env = make_imagined_environment(config, model_dir, starts, num_envs=64, seed=config.seed)
    episodes = min(IMAGINED_EPISODES, 8 * config.evaluation.episodes)
    result = evaluate(load_policy(config, model_dir, policy), env, episodes, config.evaluation.first_seed)
    stage(f"imagined success of {policy.stem}: {result.successes}/{result.episodes}")
    return result


def _operator(runner: Runner) -> Operator:
    os.environ.update(runner.environment)
    return Operator(alive=runner.check)


def _evaluate(operator: Operator, config: RunConfig, label: str, stage: _Stages) -> Evaluation:
    episodes = config.evaluation.episodes
    with tqdm(total=episodes, desc=f"real episodes {label}", unit="episode", leave=False) as bar:

        def show(done: int, rate: float) -> None:
            bar.update(done - bar.n)
            bar.set_postfix(success=f"{rate:.2f}")

        found = operator.evaluate(
            episodes=episodes, seed=config.evaluation.first_seed, deterministic=config.evaluation.deterministic,
            label=label, on_progress=show,
        )  # fmt: skip
    stage(f"real success {label}: {int(found.success.sum())}/{episodes} (95 % {found.low:.2f} to {found.high:.2f})")
    return found


def _judge(
    config: RunConfig, run_dir: Path, model_dir: Path, imagined: EvaluationResult, real: BoolArray, force: bool,
    stage: _Stages,
) -> GateReport:  # fmt: skip
    heldout = scripted_plan(config, min(config.gate.num_episodes, config.data.num_heldout), HELDOUT_SEEDS)
    bags = collect_plan(heldout, config, run_dir / "bags" / "heldout")
    report = judge_model(
        load_model_folder(model_dir), load_arrays(bags, config), config,
        (imagined.successes, imagined.episodes), (int(real.sum()), len(real)),
    )  # fmt: skip
    (run_dir / "gate.json").write_text(json.dumps(report.to_dict(), indent=1))
    console.print(report.table())
    if not report.passed and not force:
        raise GateRefused(
            f"{', '.join(report.failed)} failed (numbers in {run_dir / 'gate.json'}): the policy would learn to "
            "exploit the model. Train the model longer or on more data (--from-scratch --preset cpu_full), or go on "
            "with --force"
        )
    stage("gate passed" if report.passed else "gate FAILED, going on because of --force")
    return report


def _train(operator: Operator, updates: int) -> Any:
    with tqdm(total=updates, desc="PPO in the world model", unit="update") as bar:

        def show(feedback: Any) -> None:
            bar.update(feedback.update - bar.n)
            bar.set_postfix(imagined_success=f"{feedback.success_rate:.2f}", mean_return=f"{feedback.mean_return:.2f}")

        result = operator.train(updates, show)
        bar.update(updates - bar.n)
    return result


def _rate(success: BoolArray) -> Rate:
    low, high = wilson_interval(int(success.sum()), len(success))
    return Rate(int(success.sum()), len(success), low, high)
