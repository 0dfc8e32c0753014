"""The record of a run, config.yaml in its folder, by which the folder alone goes on with the run.

    seed: 0                       # the settings, all of them
    ppo: {updates: 24, ...}
    run:                          # what else decides the run
      preset: cpu
      settings_sha256: ...        # without the device, which may change
      options:                    # by the command or launch file that was started in the folder
        train-policy: {reward: endogenous, model_dir: null, ...}
        online_training: {reward: endogenous, num_envs: '0', ...}
      contents: {/models/mine: 9f2c..., ...}  # what lay at each path outside the folder, see training/contents.py

Options and settings that are given again must be those of the record; what may differ takes effect and is kept. So does
another path to what a model's folder, a recording or a file held when the run first named it: it was moved or copied.
"""

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic

import yaml

from wm_nodes.config.load import RECORD, Config, ConfigError, read_yaml
from wm_nodes.config.sections import SettingsSection
from wm_nodes.core.errors import first_few
from wm_nodes.core.files import write_atomic
from wm_nodes.training.contents import Contents, content_of, paths_in

CONFIG, CONTENTS, DEVICE, PRESET = "config.yaml", "contents", "device", "preset"
HERE = "<run folder>/"
"""Stands in kept options for the folder that the record lies in, so that a run can be moved."""


@dataclass(frozen=True)
class Starter(Generic[Config]):
    """A command or a launch file that begins runs and goes on with them."""

    name: str
    """Of the command or the launch file."""
    load: Callable[[str, dict[str, Any], Mapping[str, Any]], Config]
    """(preset or YAML file, dotted settings, options) -> configuration."""
    fixed: Mapping[str, Any]
    """Options that decide the run, with their defaults."""
    free: Mapping[str, Any]
    """Options that are kept and may be given anew, with their defaults."""
    names: Mapping[str, str]
    """What the user calls settings, sections of them, and options that are not called by their own names."""
    prefix: str = ""
    """Stands before the others, e.g. --."""
    joins: bool = False
    """Whether it also goes on with a run that another one began."""

    def called(self, name: str, *, option: bool = False) -> str:
        """What the user calls a dotted setting, or an option."""
        parts = name.split(".")
        sections = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
        named = next((self.names[section] for section in sections if section in self.names), "")
        return named or self.prefix + (name.replace("_", "-") if option and self.prefix else name)


@dataclass(frozen=True)
class RunRecord:
    """What a run was begun with."""

    settings: Mapping[str, Any]
    """The resolved configuration, as in the file."""
    preset: str = ""
    """Name or file that the settings were made from; empty: none."""
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Fixed and free options of each starter, by its name."""
    contents: Contents = field(default_factory=Contents)
    """Of the paths in settings and options; of a record without them they are kept from the next start on."""

    def with_device(self, device: str) -> "RunRecord":
        return replace(self, settings={**self.settings, DEVICE: device})

    def with_options(self, starter: Starter[Any], options: Mapping[str, Any]) -> "RunRecord":
        names = {*starter.fixed, *starter.free} - {PRESET}
        kept = {name: value for name, value in options.items() if name in names}
        return replace(self, options={**self.options, starter.name: kept})

    def write(self, folder: Path) -> None:
        """Write config.yaml where it is another one. Raises OSError."""
        run = {
            PRESET: self.preset, "settings_sha256": _sha256(self.settings),
            "options": _renamed(self.options, f"{folder.absolute()}/", HERE),
        }
        contents = self.contents.with_paths([self.settings, self.preset, self.options], folder.absolute())
        run |= {CONTENTS: dict(contents.kept)} if contents.kept else {}
        data = str(yaml.safe_dump({**self.settings, RECORD: run}, sort_keys=False)).encode()
        path = folder / CONFIG
        if not path.is_file() or path.read_bytes() != data:
            write_atomic(path, data)


def read_record(folder: Path) -> RunRecord | None:
    """The record in a run folder; None where there is none.

    Raises:
        ConfigError: a config.yaml that is damaged, changed since, or no record.
    """
    path = folder / CONFIG
    if not path.exists():
        return None
    settings = read_yaml(path)
    run = settings.pop(RECORD, None)
    if not isinstance(run, dict) or {*run} - {CONTENTS} != {PRESET, "settings_sha256", "options"}:
        raise ConfigError(
            f"{path} does not say how the run was begun (section {RECORD}); restore it, or begin another run folder "
            "with this file as its preset"
        )
    if run["settings_sha256"] != _sha256(settings):
        raise ConfigError(
            f"{path} is not what the run was begun with (settings_sha256 differs); restore it, or begin another run "
            "folder with this file as its preset"
        )
    options = _renamed(run["options"], HERE, f"{folder.absolute()}/")
    return RunRecord(settings, run[PRESET], options, Contents(run.get(CONTENTS, {})))


def take_up(
    folder: Path | None, starter: Starter[Config], given: Mapping[str, Any], settings: Mapping[str, Any], *,
    compare: bool = True,
) -> tuple[Config, dict[str, Any], RunRecord]:
    """Begin a run, or go on with the one in `folder`; nothing is written.

    Args:
        given: the options that were given, `preset` among them.
        settings: the dotted settings that were given.
        compare: False: of an existing run only the configuration is taken; options are those given, or defaults.

    Returns:
        The configuration, all options, and the record to be written. Of what was moved they have the path that is
        given.

    Raises:
        ConfigError: the run was begun with other options or settings, which are named, or by another command.
    """
    record = read_record(folder) if folder else None
    if folder is None or record is None:
        options = {**starter.fixed, **starter.free, **given}
        config = starter.load(options.get(PRESET, ""), dict(settings), options)
        new = RunRecord(config.model_dump(), options.get(PRESET, ""))
        return config, options, new.with_options(starter, options)
    if not starter.joins and starter.name not in record.options:
        raise ConfigError(
            f"{folder} is a run of {' and '.join(map(repr, record.options))}, not of {starter.name!r}; name another "
            "run folder"
        )
    before = {**starter.fixed, **starter.free, **(record.options.get(starter.name, given) if compare else given)}
    before |= {PRESET: record.preset} if PRESET in starter.fixed else {}
    options, saved = {**before, **given}, str(folder / CONFIG)
    config = starter.load(saved, {}, options)
    if not compare:
        return config, options, record.with_options(starter, options)
    other = starter.load(saved, dict(settings), options) if settings else config
    moved = record.contents.were_moved
    differences = {
        starter.called(name, option=True): (before[name], value)
        for name, value in given.items()
        if name in starter.fixed and before[name] != value and not moved(before[name], value)
    }
    run, now = dict(_leaves(config.model_dump())), dict(_leaves(other.model_dump()))
    elsewhere = dict[str, Any]()
    for name in {**run, **now}:
        if run.get(name) != now.get(name) and name != DEVICE and any(_lies_in(name, part) for part in settings):
            if moved(run.get(name), now.get(name)):
                elsewhere[name] = now[name]
            else:
                differences.setdefault(starter.called(name), (run.get(name), now.get(name)))
    _refuse(folder, differences, record.contents)
    if elsewhere:
        config = starter.load(saved, elsewhere, options)
        record = replace(record, settings=config.model_dump())
    record = replace(record, preset=options.get(PRESET, record.preset))
    if DEVICE in settings:
        config, record = config.with_values(device=other.device), record.with_device(other.device)
    return config, options, record.with_options(starter, options)


def keep_config(config: SettingsSection, folder: Path) -> None:
    """Begin a run folder with a configuration; of one that is begun only the device changes."""
    record, settings = read_record(folder), config.model_dump()
    (RunRecord(settings) if record is None else record.with_device(settings[DEVICE])).write(folder)


def _refuse(folder: Path, differences: Mapping[str, tuple[Any, Any]], contents: Contents) -> None:
    if differences:
        named = [
            f"{name} is {old!r} in this run, {new!r} is given{_other_contents(old, new, contents)}"
            for name, (old, new) in differences.items()
        ]
        raise ConfigError(
            f"{folder} was begun with other options: {first_few(named)}. Leave them out to go on with it, or begin "
            "another run folder"
        )


def _other_contents(old: Any, new: Any, contents: Contents) -> str:
    """Why a path is not that of the same thing, moved."""
    before, now = paths_in(old), paths_in(new)
    if len(before) != len(now) or not all(map(content_of, now)):
        return ""
    unknown = [path for path in before if not contents.of(path)]
    if unknown:
        return f" (nobody knows what {unknown[0]} held: if it was moved, link it there and go on without this option)"
    return " (which holds something else)" if before else ""


def _renamed(value: Any, old: str, new: str) -> Any:
    """Options with another beginning of the paths in them."""
    if isinstance(value, Mapping):
        return {name: _renamed(part, old, new) for name, part in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_renamed(part, old, new) for part in value]
    beginning = rf"(?<![^,]){re.escape(old)}"  # of a path, and of each of several with commas between them
    return re.sub(beginning, lambda _: new, value) if isinstance(value, str) else value


def _lies_in(name: str, section: str) -> bool:
    return f"{name}.".startswith(f"{section}.")


def _leaves(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def _sha256(settings: Mapping[str, Any]) -> str:
    """Of all that a run's settings fix."""
    fixed = {name: value for name, value in settings.items() if name != DEVICE}
    return hashlib.sha256(str(yaml.safe_dump(fixed, sort_keys=False)).encode()).hexdigest()
