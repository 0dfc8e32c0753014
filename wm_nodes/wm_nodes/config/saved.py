"""A run goes on with the configuration in its folder; what is given again must be what the folder says.

Only the device is free: a run that was begun on a GPU may go on where there is none, and the other way round.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from wm_nodes.config.load import Config, ConfigError

Load = Callable[[str, dict[str, Any]], Config]
"""(preset or YAML file, dotted changes) -> configuration."""
MOST_NAMED = 5
DEVICE = "device"
_DEVICE_LINE = re.compile(rb"^device: .*\n", re.MULTILINE)


def load_saved(
    load: Load[Config], saved: Path, preset: str | None, changes: Mapping[str, Any], names: Mapping[str, str]
) -> tuple[Config, list[str]]:
    """Return the saved configuration, with the device of the given changes, and in what else these differ from it.

    Args:
        preset: given, without knowing which one the run was begun with: all settings are compared; None: `changes` are.
        names: what the user calls a setting, by its dotted name or section; others are called as they are.
    """
    config = load(str(saved), {})
    if preset is None and not changes:
        return config, []
    other = load(preset or str(saved), dict(changes))
    run, given = dict(_leaves(config.model_dump())), dict(_leaves(other.model_dump()))
    if preset is None:
        chosen = [name for name in {**run, **given} if any(f"{name}.".startswith(f"{part}.") for part in changes)]
    else:
        chosen = list({**run, **given})
    told = {
        differs(_named(name, names), run.get(name), given.get(name)): None
        for name in chosen if name != DEVICE and run.get(name) != given.get(name)
    }
    return (config.with_values(device=other.device) if DEVICE in changes else config), list(told)


def with_device(data: bytes, device: str) -> bytes:
    """The text of a saved configuration with the device that a run goes on with; nothing else in it changes."""
    line = f"{DEVICE}: {device}\n".encode()
    return data if line in _DEVICE_LINE.findall(data) else without_device(data).rstrip() + b"\n" + line


def without_device(data: bytes) -> bytes:
    """The text of a saved configuration without the one line that may change."""
    return _DEVICE_LINE.sub(b"", data)


def differs(option: str, run: Any, given: Any) -> str:
    return f"{option} is {run!r} in this run, {given!r} is given"


def refuse_differences(folder: Path, differences: list[str]) -> None:
    """Raise ConfigError that names them, if there are any."""
    if differences:
        more = f"; and {len(differences) - MOST_NAMED} more" if len(differences) > MOST_NAMED else ""
        raise ConfigError(
            f"{folder} was begun with other options: {'; '.join(differences[:MOST_NAMED])}{more}. Leave them out to go "
            "on with it, or begin another run folder"
        )


def _named(name: str, names: Mapping[str, str]) -> str:
    parts = name.split(".")
    sections = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    return next((names[section] for section in sections if section in names), name)


def _leaves(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value
