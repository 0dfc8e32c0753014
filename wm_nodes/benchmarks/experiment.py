"""Every experiment by its name, and what an experiment is: a dataclass whose fields are its options, each explained by
the string under it, and `run()`. `wm benchmark NAME` imports the one that it starts.
"""

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin, get_type_hints

import torch
from rich.console import Console

from wm_nodes.apps.help.explanations import explanations
from wm_nodes.apps.options import positive, prepare_torch
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.files import write_atomic
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.summary import plain

EXPERIMENTS = {
    "speed": "speed.speed:Speed", "device-speed": "speed.device:DeviceSpeed",
    "view": "speed.view:View",
    "trained-in": "environments.experiments:TrainedIn", "ranking": "environments.experiments:Ranking",
    "policy": "environments.experiments:Measured", "roboscape": "environments.roboscape:RoboScape",
    "clones": "environments.clones:Clones", "replays": "environments.replays:Replays",
    "openvla-size": "environments.openvla_size:OpenVlaSize",
    "disc-base": "video_rl.discs:DiscBase", "diversity": "video_rl.diversity:DiscDiversity",
    "learning": "video_rl.discs:Learning", "ablations": "video_rl.discs:Ablations",
    "hacking": "video_rl.discs:Hacking", "cost": "video_rl.cost:Cost", "clips": "video_rl.diversity:ClipDiversity",
    "clip-learning": "video_rl.recorded:ClipLearning", "resolution": "video_rl.recorded:Resolution",
    "outcome": "video_rl.outcome:Outcome", "as-written": "video_rl.outcome:AsWritten",
    "closed-loop": "video_rl.closed_loop:ClosedLoop", "public-size": "video_rl.public_size:PublicSize",
    "erring": "judge.erring:Erring", "success-clips": "judge.success_clips:SuccessClips",
    "tables": "tables.command:Tables",
}
"""Module of this package and class, by name; what each is about stands in wm_nodes.apps.cli."""
LOG_COLUMNS = 180
"""Of tables that go to a file or a pipe."""
NO_OPTION: Mapping[str, Any] = {"option": False}
"""Metadata of a field that the command line does not set."""
Count = Annotated[int, positive]
"""A whole number from 1 on."""

console = Console()
if not console.is_terminal:
    console.width = LOG_COLUMNS


@dataclass(kw_only=True)
class Experiment:
    """What every experiment has."""

    json: Path | None = None
    """Write the numbers to this file, with command, machine and date; rows that it holds are not measured again."""
    command: str = field(default="", metadata=NO_OPTION)
    """As typed."""
    settings: dict[str, Any] = field(default_factory=dict, metadata=NO_OPTION)
    """The dotted settings that were given, of an experiment that takes any."""

    def run(self) -> int | None:
        """Measure, show, write; return an exit code, or None for 0."""
        raise NotImplementedError

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        """An option for every field."""
        kinds, about = get_type_hints(cls, include_extras=True), explanations(cls)
        for option in fields(cls):
            if option.metadata.get("option", True):
                parser.add_argument(
                    f"--{option.name.replace('_', '-')}", help=about[option.name] + _shown(option.default),
                    **_argument(kinds[option.name], option.default),
                )
        cls.add_settings(parser)

    @classmethod
    def add_settings(cls, parser: argparse.ArgumentParser) -> None:
        """Options that stand for settings; none."""

    @classmethod
    def settings_of(cls, arguments: argparse.Namespace) -> dict[str, Any]:
        """The dotted settings that those options stand for."""
        return {}

    @classmethod
    def of(cls, arguments: argparse.Namespace) -> Self:
        """The experiment that the options describe."""
        given = {one.name: getattr(arguments, one.name) for one in fields(cls) if one.metadata.get("option", True)}
        given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
        return cls(**given, command=arguments.command, settings=cls.settings_of(arguments))

    @classmethod
    def start(cls, arguments: argparse.Namespace) -> int | None:
        """Run the experiment that the options describe."""
        prepare_torch()
        return cls.of(arguments).run()

    def write(self, results: Mapping[str, Any], *, exact: bool = False, device: str = CPU) -> None:
        """Write results to `json`, if there is one, with the command, the machine and the date.

        Numbers have five digits, or all of them where `exact`. What is not finite is null. device: as in machine_facts.
        """
        if self.json is None:
            return
        facts = {"command": self.command, "machine": machine_facts(device), "date": time.strftime("%Y-%m-%d")}
        written = {**results, **facts}
        text = json.dumps(plain(written) if exact else rounded(written), indent=1)
        write_atomic(self.json, f"{text}\n".encode())

    def read(self) -> list[dict[str, Any]]:
        """The rows that `json` holds."""
        if self.json is None or not self.json.is_file():
            return []
        rows: list[dict[str, Any]] = json.loads(self.json.read_text(encoding="utf-8"))["rows"]
        return rows


@dataclass(kw_only=True)
class OnDevice(Experiment):
    """An experiment that computes on one device."""

    device: str = CPU
    """Where models compute: cpu, cuda, cuda:N or auto."""

    @property
    def where(self) -> torch.device:
        return compute_device(self.device)


def find_experiment(name: str) -> type[Experiment]:
    """The class of an experiment, whose module is imported."""
    module, _, kind = EXPERIMENTS[name].partition(":")
    found: type[Experiment] = getattr(import_module(f"benchmarks.{module}"), kind)
    return found


def rounded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values as a file holds them: plain, and numbers of five digits."""
    text = json.dumps(plain(values))
    found: dict[str, Any] = json.loads(text, parse_float=lambda digits: float(f"{float(digits):.5g}"))
    return found


def _argument(kind: Any, default: Any) -> dict[str, Any]:
    """What add_argument needs for a field of a type."""
    if kind is bool:
        return {"action": "store_true"}
    asked: dict[str, Any] = {"required": True} if default is MISSING else {"default": default}
    if get_origin(kind) is tuple:
        kind, asked["nargs"] = get_args(kind)[0], "+"
    if get_origin(kind) in (Union, UnionType):
        kind = next(part for part in get_args(kind) if part is not type(None))
    if get_origin(kind) is Annotated:
        kind = kind.__metadata__[0]
    if get_origin(kind) is Literal:
        return asked | {"choices": get_args(kind)}
    return asked | {"type": kind, "metavar": "PATH" if kind is Path else "NAME" if kind is str else "N"}


def _shown(default: Any) -> str:
    """The default in words, where it is a value that says something."""
    if default in (MISSING, None, False, (), "") or (isinstance(default, Path) and default.is_absolute()):
        return ""
    return f" (default: {' '.join(map(str, default)) if isinstance(default, tuple) else default})"
