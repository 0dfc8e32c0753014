"""Train a robot policy by RL inside a learned world model, as a ROS 2 graph, and measure it in the simulator before and
after.

Every stage leaves its files in the run folder and is skipped when they are there, so a run can be resumed by naming it.
"""

import argparse
import json
import shlex
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.apps import options
from wm_nodes.apps.model_refresh_loop import round_start, run_rounds
from wm_nodes.apps.policy_pictures import write_pictures
from wm_nodes.apps.policy_run import RunContext, is_trained, measured_rate, start_graph, success_rate
from wm_nodes.config.environments import NO_ENVIRONMENT
from wm_nodes.config.load import ConfigError, dump_config, load_config, with_judge
from wm_nodes.config.object_state import with_reader, with_truth
from wm_nodes.config.schema import AGENT, RunConfig
from wm_nodes.config.seed_ranges import HELDOUT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import part_of, parts_of, task_names
from wm_nodes.core.device import compute_device
from wm_nodes.core.errors import ModelNotAcceptedError
from wm_nodes.core.model_folder import AGAIN, MANIFEST, read_json
from wm_nodes.core.statistics import paired_difference
from wm_nodes.core.types import BoolArray
from wm_nodes.environments.registry import configured_spec, is_simulated, make_environment
from wm_nodes.judge.backends.factory import judge_name
from wm_nodes.judge.episode_reward import check_agent, episode_judge
from wm_nodes.launching.scenarios import IMAGINED
from wm_nodes.policy_rl.factories import check_inputs, check_model, load_policy, load_steppable
from wm_nodes.policy_rl.initial_policy import num_starts, prepare_start, start_files
from wm_nodes.policy_rl.pretraining import make_model
from wm_nodes.policy_rl.validation.acceptance import accept_model
from wm_nodes.policy_rl.validation.exploit_meter import start_seeds
from wm_nodes.recording import read_spec
from wm_nodes.reports.html import write_report
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.stages import Stages, console, say_files
from wm_nodes.reports.summary import Summary, acceptance_outcome, as_first_made, read_readings, write_summary
from wm_nodes.reports.tables import exploit_table, results_table, rounds_table, tasks_table
from wm_nodes.training.run_record import Starter
from wm_nodes.world_model.folder import model_spec, read_world_manifest
from wm_nodes.world_model.validation.acceptance import GOOD_ALREADY, ROOM

ENDOGENOUS = "endogenous"
ACCEPTANCE = "acceptance.json"
"""Report of accept_model in the run folder."""
FIXED = {
    "preset": "cpu", "model_dir": None, "from_scratch": False, "reward": ENDOGENOUS, "environment": IMAGINED[0],
    "video_model": None,
}
FREE = {"force": False, "compose": False}
"""Options that a run keeps with their defaults, see training/run_record.py."""


def add_options(parser: argparse.ArgumentParser) -> None:
    options.add_preset(parser, "cpu")
    parser.add_argument(
        "--task", choices=("", *task_names()),
        help='default: the preset\'s; "": none, for an environment of your own, with --model-dir and --demos',
    )
    options.add_seed(parser, None)
    options.add_run_dir(parser)
    parser.add_argument("--model-dir", type=Path, help="world model to use instead of the shipped one")
    parser.add_argument(
        "--demos", nargs="+", type=Path, metavar="BAG",
        help="recordings whose successful episodes the weak policy is cloned from, instead of planned demonstrations",
    )
    parser.add_argument(
        "--environment", choices=IMAGINED,
        help=f"what the policy is trained in; default: {IMAGINED[0]}, which also gives the policy its encoder",
    )
    parser.add_argument("--video-model", type=Path, metavar="DIR", help="folder of the video model to train in")
    parser.add_argument("--from-scratch", action="store_true", help="collect data and train the world model too")
    parser.add_argument("--force", action="store_true", help="train even in a model that does not pass acceptance")
    parser.add_argument(
        "--reward", choices=(ENDOGENOUS, AGENT),
        help="what the policy is paid for in the world model. endogenous: the model's own signal; agent: a judge's "
        "verdict on each whole episode; name the judge below, or in section judge of the settings. Default: endogenous",
    )
    options.add_judge(parser)
    parser.add_argument("--compose", action="store_true", help="all nodes in one process")
    options.add_view(parser)
    options.add_graph(parser)
    parser.set_defaults(**dict.fromkeys([*FIXED, *FREE]))


def run(arguments: argparse.Namespace) -> None:
    """Collect, check the world model, clone a weak policy, train it in the world model, measure it in the simulator."""
    options.prepare_torch()
    options.take_port(arguments)
    with opened(arguments) as (config, run_dir):
        _run(arguments, config, run_dir)


def opened(arguments: argparse.Namespace) -> AbstractContextManager[tuple[RunConfig, Path]]:
    """The run folder of the options, see options.open_run. Raises ConfigError for options that do not go together."""
    if arguments.from_scratch and arguments.model_dir:
        raise ConfigError("--from-scratch trains a world model, and --model-dir names one; give one of them")
    starter = Starter("train-policy", _load, FIXED, FREE, options.OPTION_OF, prefix="--")
    return options.open_run(
        arguments, starter, _settings(arguments), name=lambda config: config.task or "policy",
        check=partial(_check, arguments),
    )


def _run(arguments: argparse.Namespace, config: RunConfig, run_dir: Path) -> None:
    stage = Stages()
    stage(f"run folder {run_dir}")
    model_dir = _model(arguments, config, run_dir, stage)
    config = with_reader(config, model_dir)
    starts, weak = start_files(run_dir)
    job = RunContext(
        config, run_dir, starts, stage, arguments.domain_id, arguments.compose, arguments.verbose, arguments.reward,
        str(arguments.video_model or ""), arguments.view,
    )
    with ExitStack() as stack:
        first, waiting = round_start(job, 1, model_dir, weak), None
        if not is_trained(first):
            waiting = start_graph(job, first)
            stack.callback(waiting.runner.stop)
        demos = f"{config.sft.num_demonstrations} {'recorded' if config.sft.bags else 'MPLib'} demonstrations"
        stage(f"{demos}, first frames, and the weak policy cloned from them")
        prepare_start(config, run_dir, model_dir)
        if config.exploit_meter.every:
            _check_meter(config, starts, stage)
        found = run_rounds(job, model_dir, weak, partial(_judge, job, model_dir, arguments.force), waiting)
    summary = as_first_made(run_dir, Summary(
        task=config.task or model_spec(model_dir, read_world_manifest(model_dir)).task,
        preset=arguments.preset, seed=config.seed,
        real_before=measured_rate(found.real_before), real_after=measured_rate(found.real_after),
        imagined_before=success_rate(found.imagined_before), imagined_after=success_rate(found.imagined_after),
        imagined_steps_per_s=found.samples_per_s, bag=found.bag,
        paired=_paired(found.real_before, found.real_after),
        imagined_paired=_paired(found.imagined_before, found.imagined_after),
        acceptance=read_json(run_dir / ACCEPTANCE, AGAIN), samples=found.samples, minutes=stage.minutes,
        command=arguments.command, machine=machine_facts(config.device), rounds=found.table, reward=arguments.reward,
        exploit_meter=read_readings(run_dir), stopped=found.stopped,
        by_task=_by_task(config, found.real_before, found.real_after),
        judge=judge_name(episode_judge(config)) if arguments.reward == AGENT else "",
    ))
    write_summary(run_dir, summary)
    policy = load_policy(config, found.model_dir, found.policy)
    pictures = write_pictures(run_dir, config, found.model_dir, policy, HELDOUT.first)
    again = _replay(run_dir, summary.bag, found.model_dir, weak) if found.bag_is_whole else ""
    report = write_report(run_dir, summary, pictures, config_text=dump_config(config), again=again)
    if summary.rounds:
        console.print(rounds_table(summary))
    if summary.exploit_meter:
        console.print(exploit_table(summary))
    if summary.by_task:
        console.print(tasks_table(summary))
    console.print(results_table(summary))
    console.print(f"acceptance of the model: {acceptance_outcome(summary.acceptance)}")
    say_files(report, run_dir / "summary.json", summary.bag)


def _replay(run_dir: Path, bag: str, model_dir: Path, weak: Path) -> str:
    """The command that trains from a bag."""
    values = {
        "bag_uri": bag, "preset": run_dir / "config.yaml", "model_dir": model_dir, "initial_policy": weak, "rate": 100,
    }
    program = ["python3", "launch_scripts/replay_offline.launch.py"]
    return shlex.join([*program, *(f"{name}:={value}" for name, value in values.items())])


def _paired(before: BoolArray | None, after: BoolArray | None) -> dict[str, Any]:
    """Summary.paired of two evaluations in seed order."""
    if before is None or after is None:
        return {}
    return asdict(paired_difference(before.tolist(), after.tolist()))


def _by_task(config: RunConfig, before: BoolArray | None, after: BoolArray | None) -> dict[str, dict[str, Any]]:
    """Summary.by_task of two evaluations in seed order."""
    parts, first = parts_of(config.task), config.evaluation.first_seed
    if len(parts) == 1 or before is None or after is None:
        return {}
    tasks = np.array([part_of(config.task, first + episode) for episode in range(len(before))])
    pairs = {part: (before[tasks == part], after[tasks == part]) for part in parts if part in tasks}
    return {
        part: {
            "successes_before": int(old.sum()), "successes_after": int(new.sum()),
            **_paired(old, new),
        }
        for part, (old, new) in pairs.items()
    }


def _settings(arguments: argparse.Namespace) -> dict[str, Any]:
    chosen = options.settings(arguments) | options.judge_settings(arguments)
    chosen |= {} if arguments.task is None else {"task": arguments.task}
    demos = [str(bag.expanduser().absolute()) for bag in arguments.demos or ()]
    return chosen | ({"sft.bags": demos} if demos else {})


def _load(file: str, settings: dict[str, Any], chosen: Mapping[str, Any]) -> RunConfig:
    return with_judge(load_config(file, settings), chosen["reward"])


def _check(arguments: argparse.Namespace, config: RunConfig) -> None:
    compute_device(config.device)
    if arguments.model_dir and not Path(arguments.model_dir, MANIFEST).is_file():
        raise ConfigError(
            f"{arguments.model_dir} holds no {MANIFEST}; name the folder of a trained world model with "
            "--model-dir, also where this run's was moved"
        )
    if not config.task:
        _check_without_task(arguments, config)
    elif arguments.from_scratch:
        check_inputs(config, configured_spec(with_truth(config)))
    else:
        model_dir = Path(arguments.model_dir or shipped_model(config.task))
        spec = configured_spec(with_reader(config, model_dir))
        check_model(spec, model_dir, model_spec(model_dir, read_world_manifest(model_dir)))
        check_inputs(config, spec)
    for bag in config.sft.bags:
        if not Path(bag).exists():
            raise ConfigError(
                f"{bag} does not exist; name the recordings with --demos, also where this run's were moved"
            )
        read_spec(Path(bag))
    if config.model_refresh.num_rounds > 1 and not is_simulated(config):
        raise ConfigError(f"model_refresh.num_rounds is {config.model_refresh.num_rounds}, and rounds collect in the "
                          "simulator; give 1, or a task and evaluation.environment maniskill")
    _check_environment(arguments, config)
    if config.exploit_meter.every and config.exploit_meter.episodes > num_starts(config):
        raise ConfigError(f"exploit_meter.episodes is {config.exploit_meter.episodes}, and this run has "
                          f"{num_starts(config)} first frames (8 x evaluation.episodes, at most 256); lower it")
    judge = options.judge_settings(arguments)
    if judge and arguments.reward != AGENT:
        raise ConfigError(f"{', '.join(judge)} would change nothing without --reward agent")
    if arguments.reward == AGENT:
        check_agent(config)


def _check_without_task(arguments: argparse.Namespace, config: RunConfig) -> None:
    """Everything that the simulator gives has to come from elsewhere, and to fit the model."""
    for missing, remedy in (
        (not arguments.model_dir, "name a model of your recordings with --model-dir"),
        (not config.sft.bags, "name recordings of demonstrations with --demos"),
        (arguments.from_scratch, "leave --from-scratch out: it collects in the simulator"),
        (arguments.video_model, "leave --video-model out: it is of a task"),
        (config.exploit_meter.every, "set exploit_meter.every to 0: it replays in the simulator"),
    ):
        if missing:
            raise ConfigError(f"task is empty; {remedy}")
    if (name := config.evaluation.environment) != NO_ENVIRONMENT:
        model_dir = Path(arguments.model_dir)
        with closing(make_environment(config, name, num_envs=1, seed=config.seed)) as environment:
            check_model(environment.spec, model_dir, model_spec(model_dir, read_world_manifest(model_dir)))


def _check_environment(arguments: argparse.Namespace, config: RunConfig) -> None:
    if (arguments.environment == "video_model") != bool(arguments.video_model):
        raise ConfigError("--environment video_model and --video-model DIR go together; give both, or none")
    if arguments.video_model:
        if not Path(arguments.video_model, MANIFEST).is_file():
            raise ConfigError(
                f"{arguments.video_model} holds no {MANIFEST}; name the folder of a trained video model with "
                "--video-model, also where this run's was moved"
            )
        load_steppable(config, Path(arguments.video_model))
        if (rounds := config.model_refresh.num_rounds) > 1:
            raise ConfigError(
                f"model_refresh.num_rounds is {rounds}: that refreshes a world model, and a video model is trained in; "
                "give 1"
            )


def _check_meter(config: RunConfig, starts: Path, stage: Stages) -> None:
    """Say why the learner will take no readings of the exploit meter, where it will not."""
    try:
        start_seeds(config, starts)
    except ValueError as error:
        stage(f"the exploit meter is off: {error}")


def _model(arguments: argparse.Namespace, config: RunConfig, run_dir: Path, stage: Stages) -> Path:
    if arguments.from_scratch:
        stage(f"world model from scratch: {config.data.num_episodes} simulator episodes, tokenizer, dynamics")
        return make_model(config, run_dir, command=arguments.command)
    model_dir = arguments.model_dir or shipped_model(config.task)
    stage(f"world model {model_dir}")
    return Path(model_dir).expanduser().absolute()


def _judge(job: RunContext, model_dir: Path, force: bool, imagined: BoolArray, real: BoolArray | None) -> None:
    """Write acceptance.json and print it; raise ModelNotAcceptedError where the model failed and `force` is not set. A
    model about which too few episodes decide nothing is trained in, and the run says so."""
    config = job.config
    successes = (int(imagined.sum()), len(imagined)), None if real is None else (int(real.sum()), len(real))
    report = accept_model(
        config, model_dir, load_policy(config, model_dir, start_files(job.run_dir)[1]), *successes,
        job.run_dir / "bags" / "heldout", video_model_dir=Path(job.video_model) if job.video_model else None,
    )
    path = job.run_dir / ACCEPTANCE
    path.write_text(json.dumps(report.to_dict(), indent=1), encoding="utf-8")
    console.print(report.table())
    if report.failed and not force:
        if all(name.startswith(ROOM) for name in report.failed):
            raise ModelNotAcceptedError(
                f"{', '.join(report.failed)} failed (numbers in {path}): training could only lower this policy; "
                f"{GOOD_ALREADY}, or go on with --force"
            )
        preset = "scenes" if config.simulation.scenes else "cpu_full"
        again = f"--from-scratch --preset {preset}" if config.task else "wm train-model"
        raise ModelNotAcceptedError(
            f"{', '.join(report.failed)} failed (numbers in {path}): the policy would learn to exploit the model. "
            f"Train the model longer or on more data ({again}), or go on with --force"
        )
    job.stage(f"acceptance {report.words}" + (", going on because of --force" if report.failed else ""))
