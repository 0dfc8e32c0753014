"""Train a world model on recordings: pictures, actions, a success flag, and states where there are any.

    wm train-model --bags B... --out FOLDER
    wm train-policy --task "" --model-dir FOLDER/model --demos B... --evaluation.environment none

A quarter of the episodes is held out, and the model is judged by rollouts of them. FOLDER/model/acceptance.json says
what passed, what failed, and what could not be judged. The folder alone goes on with a training that was interrupted.
Where instructions differ, or with --reward.dense_weight 1, it imagines goals, too, learned from the episodes that
succeed.
"""

import argparse
import json
import shlex
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

from wm_nodes.apps import options
from wm_nodes.config.extensions import SUFFIX, name_file
from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import VARIABLE, check_task
from wm_nodes.core.device import compute_device
from wm_nodes.core.errors import ModelNotAcceptedError
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import MANIFEST
from wm_nodes.policy_rl.pretraining import model_from_data, read_recordings
from wm_nodes.reports.stages import Stages, console
from wm_nodes.training.run_record import Starter
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.validation.acceptance import report_when_made
from wm_nodes.world_model.validation.acceptance_report import AcceptanceReport, number_of
from wm_nodes.world_model.validation.pictures import horizon_table, horizons_of

MODEL = "model"
"""In the run folder."""
ACCEPTANCE = "acceptance.json"
"""In the model folder."""
FIXED = {"preset": "cpu", "bags": None, "task": ""}
"""Options that a run keeps with their defaults, see training/run_record.py."""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--bags", nargs="+", type=Path, metavar="BAG", help="recordings of one environment, the graph's or imported"
    )
    parser.add_argument(
        "--task", metavar="NAME|FILE",
        help="the task of the recordings, by its name or its file (config/tasks.py); its success rule, where it has "
        "one, labels them. Default: the recorded success flag does",
    )
    parser.add_argument(
        "--out", "--run-dir", dest="run_dir", type=Path, metavar="FOLDER",
        help="gets the model, metrics and checkpoints; an existing one goes on, with the options it was begun with "
        "(default: runs/<time>-model)",
    )
    options.add_preset(parser, "cpu")
    options.add_seed(parser, None)
    parser.set_defaults(**dict.fromkeys(FIXED))


def run(arguments: argparse.Namespace) -> None:
    """Train and judge; raises ModelNotAcceptedError where a criterion failed, with the model written."""
    options.prepare_torch()
    stage = Stages()
    with opened(arguments) as (config, folder):
        stage(f"run folder {folder}")
        model = folder / MODEL
        if arguments.data is not None:
            data, starts = arguments.data
            model_from_data(data, starts, config, model, command=arguments.command, say=stage)
        report = _judge(config, model)
        stage(f"acceptance {report.words}")
        following = shlex.join(["--model-dir", str(model), "--demos", *map(str, arguments.bags)])
        for name, value in (("model", model), ("verdict", model / ACCEPTANCE),
                            ("next", f'wm train-policy --task "" {following} --evaluation.environment none')):
            console.print(f"{name:8} {value}", highlight=False, soft_wrap=True, markup=False)
        if report.failed:
            raise ModelNotAcceptedError(
                f"{', '.join(report.failed)} failed (numbers in {model / ACCEPTANCE}); train-policy takes the model "
                "only with --force"
            )


def opened(arguments: argparse.Namespace) -> AbstractContextManager[tuple[RunConfig, Path]]:
    """The run folder of the options, see options.open_run; what will be trained on is read into arguments.data, None
    where the model is there."""
    def check(config: RunConfig) -> None:
        compute_device(config.device)
        if not arguments.bags:
            raise ConfigError("name recordings with --bags")
        task = _task_of(arguments.task) if arguments.task else ""
        is_made = arguments.run_dir and (arguments.run_dir.expanduser() / MODEL / MANIFEST).exists()
        arguments.data = None if is_made else read_recordings([*map(Path, arguments.bags)], config, task)

    starter = Starter("train-model", _load, FIXED, {}, options.OPTION_OF, prefix="--")
    return options.open_run(
        arguments, starter, options.settings(arguments), name=lambda config: "model", check=check
    )


def _load(file: str, settings: dict[str, Any], chosen: object) -> RunConfig:
    return load_config(file, {**settings, "task": ""})


def _task_of(given: str) -> str:
    """The name of a known task, or of one in a file, which is known from then on. Raises ConfigError, ValueError."""
    file = Path(given)
    if file.suffix != SUFFIX:
        return check_task(given)
    if not file.is_file():
        raise ConfigError(f"--task {given} is no file")
    return check_task(name_file(file, VARIABLE))


def _judge(config: RunConfig, model: Path) -> AcceptanceReport:
    """Write acceptance.json and print it."""
    manifest = read_world_manifest(model)
    metrics = {name: number_of(value) for name, value in manifest["heldout"].items()}
    report = replace(report_when_made(manifest, config), metrics=metrics)
    write_atomic(model / ACCEPTANCE, json.dumps(report.to_dict(), indent=1).encode())
    console.print(report.table())
    if horizons_of(metrics):
        console.print(horizon_table(metrics))
    return report
