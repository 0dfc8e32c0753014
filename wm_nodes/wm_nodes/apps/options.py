"""Options that several verbs have, said once, the settings that they stand for, and the run that they name."""

import argparse
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch

from wm_nodes.config.load import POLICY, VIDEO, Config, judge_overrides, preset_names, with_full_paths
from wm_nodes.config.tasks import task_names
from wm_nodes.core.memory import keep_freed_memory
from wm_nodes.launching.scenarios import PAGE
from wm_nodes.reports.live_page import HOST, free_port
from wm_nodes.training.run_lock import RunLock
from wm_nodes.training.run_record import Starter, take_up

JUDGE = "judge"
"""In place of a loop: the settings of the judge."""
NOT_GIVEN: tuple[Any, ...] = (None, "", [])
OPTION_OF = {
    "seed": "--seed", "task": "--task", "rewards": "--reward", "judge.kind": "--judge", "judge.endpoints": "--judge",
    "judge.folder": "--judge", "judge.model": "--judge-model", "judge.api_key_env": "--judge-key-env",
    "judge.rubric": "--rubric", "sft.bags": "--demos", "run_folder": "run",
}
"""What the user calls settings that have an option of their own, and what is no option."""


def add_preset(parser: argparse.ArgumentParser, default: str, loop: str = POLICY) -> None:
    """--preset, --device and every setting of a loop; of loop 2 also --task."""
    names = ", ".join(preset_names(loop))
    parser.add_argument("--preset", default=default, help=f"one of {names}, or a .yaml (default: {default})")
    if loop == VIDEO:
        parser.add_argument("--task", choices=task_names(), help="whose recordings they are (default: the preset's)")
    add_settings(parser, loop)
    add_device(parser)


def add_settings(parser: argparse.ArgumentParser, loop: str = POLICY) -> None:
    """Every setting of a loop, or of its judge alone, as an option: cli.Parser puts those given into
    `arguments.settings`, by their dotted names."""
    if parser.get_default("settings_of") is None:
        example = {POLICY: "ppo.updates 10", VIDEO: "grpo.clip 0.1", JUDGE: "judge.max_reads 3"}[loop]
        parser.add_argument(
            "--SECTION.KEY", metavar="VALUE", help=f"one of the {loop} settings below, in YAML, e.g. --{example}"
        )
        parser.set_defaults(settings_of=loop)


def add_device(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """default: None leaves it to the preset."""
    shown = default or "the preset's"
    parser.add_argument(
        "--device", default=default, help=f"where models compute: cpu, cuda, cuda:N or auto (default: {shown})"
    )


def add_seed(parser: argparse.ArgumentParser, default: int | None = 0) -> None:
    """default: None leaves it to the preset."""
    shown = "the preset's" if default is None else default
    parser.add_argument("--seed", type=int, default=default, help=f"of every random number (default: {shown})")


def add_run_dir(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--run-dir", type=Path,
        help="run folder; an existing one goes on, with the options it was begun with (default: runs/<time>-<name>)",
    )


def add_json(parser: argparse.ArgumentParser, about: str = "also write the numbers to this file") -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help=about)


def add_judge(parser: argparse.ArgumentParser) -> None:
    """Who judges where the reward is the agent's; judge_settings reads them."""
    add_settings(parser, JUDGE)
    parser.add_argument(
        "--judge", default="", metavar="URL[,URL]|embedded|FOLDER",
        help="the judge's servers, e.g. http://host:8000/v1; or a judge without one (default: embedded)",
    )
    parser.add_argument("--judge-model", default="", metavar="NAME", help="its name on the server")
    parser.add_argument("--judge-key-env", default="", metavar="VARIABLE", help="environment variable with its key")
    parser.add_argument("--rubric", default="", help="rubric pack: a name, or a .yaml file")


def add_graph(parser: argparse.ArgumentParser) -> None:
    """Options of verbs that start a ROS graph."""
    parser.add_argument("--domain-id", default="", help="ROS domain 0 to 101 (default: $ROS_DOMAIN_ID, else 0)")
    parser.add_argument("--verbose", action="store_true", help="show the nodes' logs (they are in <run>/logs anyway)")


def add_view(parser: argparse.ArgumentParser) -> None:
    """--view; take_port reads it."""
    parser.add_argument(
        "--view", nargs="?", const="0", default="", metavar="PORT",
        help="open a live page for this host: pictures, done signal, curves, verdicts, nodes (port: a free one)",
    )


def take_port(arguments: argparse.Namespace) -> None:
    """Make `arguments.view` the launch arguments that --view stands for, and say where the page will be. Raises
    ValueError: as free_port."""
    given = arguments.view
    arguments.view = {"view": PAGE, "view_port": free_port(given)} if given else {}
    if given:
        print(f"live page http://{HOST}:{arguments.view['view_port']}/", flush=True)


def add_tensorboard(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--tensorboard", action=argparse.BooleanOptionalAction, default=True, help="also write <run>/tensorboard"
    )


def positive(text: str) -> int:
    """A whole number from 1 on, as the type of an option."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 1 on")
    return int(text)


def judge_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """The dotted settings that the options of add_judge stand for, and those of the judge that were given as such."""
    named = judge_overrides(arguments.judge, arguments.judge_model, arguments.judge_key_env, arguments.rubric)
    typed = with_full_paths(arguments.settings)
    return named | {name: value for name, value in typed.items() if name.startswith("judge.")}


def settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """The dotted settings that were given, by their names or as --seed or --device, of loop 2 also --task."""
    named = ("seed", "task") if arguments.settings_of == VIDEO else ("seed",)
    given = {name: getattr(arguments, name, None) for name in named}
    return {
        **with_full_paths(arguments.settings), **device_settings(arguments),
        **{name: value for name, value in given.items() if value is not None},
    }


def device_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """The setting that a given --device stands for."""
    device = getattr(arguments, "device", None)
    return {} if device is None else {"device": device}


@contextmanager
def open_run(
    arguments: argparse.Namespace, starter: Starter[Config], settings: Mapping[str, Any], *,
    name: Callable[[Config], str], check: Callable[[Config], None],
) -> Iterator[tuple[Config, Path]]:
    """Hold the run folder of --run-dir, or a new one, and give its configuration; the starter's options are set in
    `arguments` to those of the run, paths as text.

    Args:
        settings: the dotted settings that the given options stand for.
        name: of a new folder, behind its time.
        check: raises for a configuration that is no use.

    Raises:
        ConfigError: see take_up. RunFolderInUseError: see RunLock.
    """
    options = {option: _full_paths(getattr(arguments, option)) for option in {**starter.fixed, **starter.free}}
    given = {option: value for option, value in options.items() if value not in NOT_GIVEN}
    with ExitStack() as stack:
        run_dir: Path | None = arguments.run_dir and Path(arguments.run_dir).expanduser().absolute()
        if run_dir:
            stack.enter_context(RunLock(run_dir))
        config, chosen, record = take_up(run_dir, starter, given, settings)
        vars(arguments).update(chosen)
        check(config)
        if not run_dir:
            new = Path("runs", f"{time.strftime('%Y%m%d-%H%M%S')}-{name(config)}").absolute()
            run_dir = stack.enter_context(RunLock(new, new=True)).folder
        record.write(run_dir)
        yield config, run_dir


def _full_paths(value: Any) -> Any:
    """An option's value as the record holds it: paths in full, also that of a preset's or a task's file."""
    if isinstance(value, list):
        return [_full_paths(part) for part in value]
    if isinstance(value, Path) or Path(str(value)).suffix in {".yaml", ".yml", ".py"}:
        return str(Path(value).expanduser().resolve())
    return value


def prepare_torch() -> None:
    """Let torch compute on $OMP_NUM_THREADS cores, else on one. Freed memory is kept."""
    keep_freed_memory()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
