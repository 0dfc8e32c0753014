"""Options that several verbs have, said once, and the settings that they stand for."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from wm_nodes.config.load import judge_overrides, parse_override
from wm_nodes.core.allocator import keep_freed_memory


def add_preset(parser: argparse.ArgumentParser, default: str, names: Sequence[str]) -> None:
    """--preset and --set. names: the presets that there are."""
    parser.add_argument("--preset", default=default, help=f"one of {', '.join(names)}, or a .yaml (default: {default})")
    add_set(parser)
    add_device(parser)


def add_device(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """default: None leaves it to the preset."""
    shown = default or "the preset's"
    parser.add_argument(
        "--device", default=default, help=f"where models compute: cpu, cuda, cuda:N or auto (default: {shown})"
    )


def add_set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one setting")


def add_seed(parser: argparse.ArgumentParser, default: int | None = 0) -> None:
    """default: None leaves it to the preset."""
    shown = "the preset's" if default is None else default
    parser.add_argument("--seed", type=int, default=default, help=f"of every random number (default: {shown})")


def add_run_dir(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--run-dir", type=Path,
        help="run folder; an existing one goes on, with the options it was begun with (default: runs/<time>-<name>)",
    )


def add_threads(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--threads", type=int, default=1, help="cores; other numbers give other last bits (default: 1)")


def add_json(parser: argparse.ArgumentParser, about: str = "also write the numbers to this file") -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help=about)


def add_judge(parser: argparse.ArgumentParser) -> None:
    """Who judges where the reward is the agent's; judge_settings reads them."""
    parser.add_argument(
        "--judge", default="", metavar="URL[,URL]|embedded|FOLDER",
        help="the judge's servers, e.g. http://host:8000/v1; or a judge without one (default: embedded)",
    )
    parser.add_argument("--judge-model", default="", metavar="NAME", help="its name on the server")
    parser.add_argument("--judge-key-env", default="", metavar="VARIABLE", help="environment variable with its key")
    parser.add_argument(
        "--judge-field", action="append", default=[], metavar="NAME=VALUE",
        help="further field of every request to it, in YAML, e.g. 'chat_template_kwargs={enable_thinking: false}'",
    )
    parser.add_argument("--rubric", default="", help="rubric pack: a name, or a .yaml file")


def add_graph(parser: argparse.ArgumentParser) -> None:
    """Options of verbs that start a ROS graph."""
    parser.add_argument("--domain-id", default="", help="ROS domain 0 to 101 (default: $ROS_DOMAIN_ID, else 0)")
    parser.add_argument("--verbose", action="store_true", help="show the nodes' logs (they are in <run>/logs anyway)")


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
    """The dotted settings that the options of add_judge stand for."""
    fields = dict(parse_override(text) for text in arguments.judge_field)
    named = judge_overrides(arguments.judge, arguments.judge_model, arguments.judge_key_env, arguments.rubric)
    return named | {f"judge.extra_body.{name}": value for name, value in fields.items()}


def settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """The dotted settings that --set and a given --seed or --device stand for."""
    overrides = dict(parse_override(text) for text in arguments.set) | device_settings(arguments)
    seed = getattr(arguments, "seed", None)
    return overrides if seed is None else overrides | {"seed": seed}


def device_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """The setting that a given --device stands for."""
    device = getattr(arguments, "device", None)
    return {} if device is None else {"device": device}


def prepare_torch(count: int | None = None) -> None:
    """Let torch compute on `count` cores; None: on $OMP_NUM_THREADS of them, else on one. Freed memory is kept."""
    keep_freed_memory()
    torch.set_num_threads(count or int(os.environ.get("OMP_NUM_THREADS", "1")))
