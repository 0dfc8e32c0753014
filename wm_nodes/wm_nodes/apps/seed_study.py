"""Compare RL in the world model with RL in the simulator, over several seeds and tasks, with intervals.

By policy_rl/train.py, in one process: the updates are bit-equal to those of the graph, without its start-up. In the
world model, model_refresh.num_rounds above 1 trains in rounds, see policy_rl/model_refresh.py.
Each (task, seed, arm) is one line of results.jsonl with its settings; a line of the same settings and model is not run
again. Models that acceptance refuses are trained in all the same, and their lines say so.
"""

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.table import Table

from wm_nodes.apps.options import add_preset, add_threads, prepare_torch, settings
from wm_nodes.apps.policy_run import success_rate
from wm_nodes.config.load import dump_config, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import default_task, model_tasks
from wm_nodes.core.device import compute_device
from wm_nodes.core.files import text_lines
from wm_nodes.core.model_folder import files_sha256
from wm_nodes.core.progress import tqdm
from wm_nodes.core.statistics import paired_difference
from wm_nodes.core.types import Environment
from wm_nodes.environments.registry import make_environment
from wm_nodes.policy_rl.factories import load_policy, make_imagined_environment, make_reward
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.initial_policy import prepare_start
from wm_nodes.policy_rl.model_refresh import Round, refresh_round, run_rounds, split_updates
from wm_nodes.policy_rl.rollouts import rollout_statistics
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.policy_rl.validation.acceptance import accept_model
from wm_nodes.policy_rl.validation.evaluation import EvaluationResult, evaluate
from wm_nodes.policy_rl.validation.exploit_meter import ExploitMeter, make_exploit_meter
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.summary import acceptance_outcome
from wm_nodes.training.weights import save_weights
from wm_nodes.world_model.folder import read_world_manifest

ARMS = ("world_model", "simulator")
SIMULATOR_ENVS = 8
IMAGINED_EPISODES = 256


@dataclass
class _Trained:
    """What one training gave."""

    course: list[dict[str, float]]
    """Of each update, see _train."""
    model_dir: Path
    """Trained in last."""
    readings: list[dict[str, float]] = field(default_factory=list)
    """Rows of the exploit meter."""
    refreshes: list[dict[str, Any]] = field(default_factory=list)
    """The decision on each refreshed model."""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", nargs="+", default=model_tasks(default_task()))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    add_preset(parser, "cpu")
    parser.add_argument("--model-dir", type=Path, help="world model; default: the shipped one")
    add_threads(parser)
    parser.add_argument("--out", type=Path, default=Path("runs/study"), help="folder; finished runs in it are kept")


def run(arguments: argparse.Namespace) -> None:
    """Run what is not in the folder yet, and print a line per run."""
    folder = arguments.out.expanduser().absolute()
    folder.mkdir(parents=True, exist_ok=True)
    prepare_torch(arguments.threads)
    configs = set[str]()
    for task in arguments.tasks:
        for seed in arguments.seeds:
            config = load_config(arguments.preset, {"task": task, "seed": seed, **settings(arguments)})
            compute_device(config.device)
            if "simulator" in arguments.arms and config.environment.factory != config.evaluation.environment:
                raise ValueError(f"environment.factory is {config.environment.factory}, and policies are measured in "
                                 f"evaluation.environment {config.evaluation.environment}; set both to the same")
            model_dir, text = arguments.model_dir or shipped_model(task), dump_config(config)
            configs.add(text)
            made = {"config": text, "world_model_sha256": files_sha256(read_world_manifest(model_dir))}
            for arm in arguments.arms:
                identity = {"task": task, "arm": arm, "seed": seed, **made}
                if not any(identity.items() <= _plain_items(row) for row in read_results(folder)):
                    _run(config, arm, model_dir, folder, identity)
    rows = read_results(folder)
    Console().print(table(rows))
    if (gain := gain_over_simulator([row for row in rows if row["config"] in configs])) is not None:
        print(f"RL in the world model less RL in the simulator, mean over the tasks: {gain:+.1f} points")


def read_results(folder: Path) -> list[dict[str, Any]]:
    path = folder / "results.jsonl"
    rows = []
    for number, line in enumerate(text_lines(path.read_bytes()) if path.exists() else [], 1):
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            text = f"{path}, line {number} is cut short ({error}); delete the line to do its run again"
            raise ValueError(text) from None
    return rows


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per run, and per task, arm and settings the pooled paired difference."""
    columns = ("task", "trained in", "seed", "real before", "real after", "difference (95 %)", "imagined", "acceptance")
    lines = Table(*columns)
    for row in rows:
        before, after, pair = row["real_before"], row["real_after"], row["paired"]
        imagined = row["imagined_before"], row["imagined_after"]
        lines.add_row(
            row["task"], row["arm"].replace("_", " "), str(row["seed"]), _percent(before), _percent(after),
            f"{100 * pair['difference']:+.1f} ({100 * pair['low']:+.1f} to {100 * pair['high']:+.1f})",
            f"{_percent(imagined[0])} -> {_percent(imagined[1])}", acceptance_outcome(row["acceptance"]),
        )
    groups = dict[tuple[str, str, str], list[dict[str, Any]]]()
    for row in rows:
        lines_of = row.get("config", "").splitlines()
        settings_of = "\n".join(line for line in lines_of if not line.startswith("seed:"))
        groups.setdefault((row["task"], row["arm"], settings_of), []).append(row)
    for (task, arm, _), chosen in sorted(groups.items()):
        pooled = paired_difference(
            [bool(x) for row in chosen for x in row["success_before"]],
            [bool(x) for row in chosen for x in row["success_after"]],
        )
        lines.add_row(
            task, arm.replace("_", " "), f"all {len(chosen)}", "", f"n = {pooled.episodes}",
            f"{100 * pooled.difference:+.1f} ({100 * pooled.low:+.1f} to {100 * pooled.high:+.1f})", "", "",
        )
    return lines


def mean_gain(rates: Mapping[tuple[str, str, str], float], training: str, baseline: str) -> float:
    """Mean over policies and tasks of rate(training) - rate(baseline), in the unit of the rates, as RoboScape-R reports
    it. rates: a success rate for each policy, training and task.

    Raises:
        ValueError: a cell that only one of the two trainings has, or none at all.
    """
    names = {name: {(policy, task) for policy, other, task in rates if other == name} for name in (training, baseline)}
    alone = names[training] ^ names[baseline]
    if alone or not names[training]:
        raise ValueError(
            f"{training!r} and {baseline!r} have been measured on different cells: {sorted(alone) or 'none'}; "
            "leave out what has no fellow"
        )
    return fmean(rates[policy, training, task] - rates[policy, baseline, task] for policy, task in names[training])


def gain_over_simulator(rows: Sequence[dict[str, Any]]) -> float | None:
    """By how many points RL in the world model ends above RL in the simulator: mean over tasks, each on the seeds that
    both arms have; None where no task has both."""
    after = {(row["task"], row["seed"], row["arm"]): row["real_after"] for row in rows}
    rates: dict[tuple[str, str, str], float] = {}
    for task in {task for task, _, _ in after}:
        tried = [{seed for other, seed, done in after if (other, done) == (task, arm)} for arm in ARMS]
        seeds = set.intersection(*tried)
        for arm in ARMS if seeds else ():
            found = [after[task, seed, arm] for seed in seeds]
            successes, episodes = (sum(result[name] for result in found) for name in ("successes", "episodes"))
            rates["image policy", arm, task] = 100 * successes / episodes
    return mean_gain(rates, *ARMS) if rates else None


def _plain_items(row: Mapping[str, Any]) -> set[tuple[str, Any]]:
    return {(name, value) for name, value in row.items() if isinstance(value, str | int)}


def _run(config: RunConfig, arm: str, model_dir: Path, folder: Path, identity: Mapping[str, Any]) -> None:
    started = time.monotonic()
    run_dir = folder / f"{config.task or 'own'}_{config.seed}"
    starts, weak = prepare_start(config, run_dir, model_dir)
    policy = load_policy(config, model_dir, weak)
    real = make_environment(config, config.evaluation.environment, num_envs=SIMULATOR_ENVS, seed=config.seed)

    def measure(folder: Path) -> tuple[EvaluationResult, EvaluationResult]:
        """In evaluation.environment and in the world model of a folder."""
        how = config.evaluation
        imagined = make_imagined_environment(config, folder, starts, num_envs=config.ppo.num_envs, seed=config.seed)
        return (
            evaluate(policy, real, how.episodes, how.first_seed, how.deterministic),
            evaluate(policy, imagined, IMAGINED_EPISODES, how.first_seed),
        )

    real_before, imagined_before = measure(model_dir)
    acceptance = accept_model(
        config, model_dir, policy, (imagined_before.successes, imagined_before.episodes),
        (real_before.successes, real_before.episodes), run_dir / "bags" / "heldout",
    )
    print(f"{config.task}, seed {config.seed}: acceptance {acceptance.words}")
    if arm == "simulator":
        trained = _Trained(_train(policy, real, config, arm, model_dir), model_dir)
    else:
        trained = _train_in_rounds(policy, real, config, model_dir, starts, run_dir)
    real_after, imagined_after = measure(trained.model_dir)
    real.close()
    save_weights(policy, run_dir / f"{arm}.safetensors", {"tokenizer_sha256": policy.encoder.sha256})
    row = {
        **identity, "real_before": asdict(success_rate(real_before.success)),
        "real_after": asdict(success_rate(real_after.success)),
        "imagined_before": asdict(success_rate(imagined_before.success)),
        "imagined_after": asdict(success_rate(imagined_after.success)),
        "paired": asdict(paired_difference(real_before.success.tolist(), real_after.success.tolist())),
        "accepted": acceptance.passed, "acceptance": acceptance.to_dict(),
        "environment_steps": sum(c["steps"] for c in trained.course),
        "success_before": real_before.success.astype(int).tolist(),
        "success_after": real_after.success.astype(int).tolist(), "course": trained.course,
        "exploit_meter": trained.readings, "refreshes": trained.refreshes,
        "minutes": (time.monotonic() - started) / 60, "machine": machine_facts(config.device),
    }
    with open(folder / "results.jsonl", "a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def _train_in_rounds(
    policy: ImagePolicy, real: Environment, config: RunConfig, model_dir: Path, first_frames: Path, run_dir: Path
) -> _Trained:
    """Train in place."""
    trained = _Trained([], model_dir)

    def train(part: Round) -> bool:
        env = make_imagined_environment(
            part.config, part.model_dir, part.starts, num_envs=config.ppo.num_envs, seed=part.config.seed, training=True
        )
        meter = make_exploit_meter(part.config, part.model_dir, first_frames, lambda: real)
        made = sum(split_updates(config.ppo.updates, config.model_refresh.num_rounds)[: part.number - 1])
        trained.course += _train(policy, env, part.config, "world_model", part.model_dir, meter)
        trained.readings += [] if meter is None else [{**row, "update": row["update"] + made} for row in meter.rows()]
        trained.model_dir = part.model_dir
        if part.last:
            return False
        weights = part.folder / "policy.safetensors"
        weights.parent.mkdir(parents=True, exist_ok=True)
        save_weights(policy, weights, {"tokenizer_sha256": policy.encoder.sha256})
        verdict = refresh_round(config, part.model_dir, weights, first_frames, run_dir, part.number)
        trained.refreshes.append(verdict.to_dict())
        return verdict.accepted

    run_rounds(config, run_dir, model_dir, first_frames, train)
    return trained


def _train(
    policy: ImagePolicy, env: Environment, config: RunConfig, arm: str, model_dir: Path,
    meter: ExploitMeter | None = None,
) -> list[dict[str, float]]:
    """Train in place; return success rate, KL and environment steps of each update."""
    reward = make_reward(config, None if arm == "simulator" else model_dir, golden=True)
    course: list[dict[str, float]] = []
    with tqdm(total=config.ppo.updates, desc=f"{config.task} seed {config.seed} in {arm}", unit="update") as bar:
        for rollout, metrics in train_policy(policy, env, reward, config, meter):
            success_rate, steps = rollout_statistics(rollout).success_rate, float(rollout.valid_TN.sum())
            course.append({"success_rate": success_rate, "kl_reference": metrics.kl_reference, "steps": steps})
            bar.update()
            bar.set_postfix(success=f"{success_rate:.2f}", refresh=False)
    return course


def _percent(successes: dict[str, float]) -> str:
    share = successes["successes"] / successes["episodes"]
    return f"{100 * share:.1f} % ({successes['successes']}/{successes['episodes']})"
