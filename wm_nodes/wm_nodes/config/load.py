"""Presets: base.yaml holds every number; task, preset and command line override some of them, in this order."""

from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from wm_nodes.config.schema import RunConfig

TASK_PREFIX = "task_"
"""presets/task_<name>.yaml holds what differs between tasks; it lies between base and the preset."""


class ConfigError(ValueError):
    """A setting or preset that does not exist or is out of range."""


def preset_names() -> list[str]:
    folder = resources.files("wm_nodes.config") / "presets"
    names = (Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".yaml"))
    return sorted(name for name in names if not name.startswith(TASK_PREFIX))


def load_config(preset: str = "cpu", overrides: dict[str, Any] | None = None) -> RunConfig:
    """Return the resolved configuration.

    Args:
        preset: a name from preset_names(), or a path of a YAML file of overrides on base.
        overrides: dotted names to values, e.g. {"ppo.updates": 10}.

    Raises:
        ConfigError: names the value, what is allowed, and where to look.
    """
    values = _read_preset("base")
    chosen = _read_preset(preset)
    task = (overrides or {}).get("task", chosen.get("task", values["task"]))
    _merge(values, _read_task(task))
    if preset != "base":
        _merge(values, chosen)
    for dotted, value in (overrides or {}).items():
        _set_dotted(values, dotted, value)
    try:
        return RunConfig.model_validate(values)
    except ValidationError as error:
        lines = [f"  {'.'.join(map(str, e['loc']))}: {e['msg']} (got {e['input']!r})" for e in error.errors()]
        raise ConfigError("configuration refused; see wm_nodes/config/schema.py:\n" + "\n".join(lines)) from None


def dump_config(config: RunConfig) -> str:
    """The resolved configuration as YAML, as saved with every run."""
    return str(yaml.safe_dump(config.model_dump(), sort_keys=False))


def parse_override(text: str) -> tuple[str, Any]:
    """Split `section.key=value` from the command line; the value is read as YAML."""
    name, separator, value = text.partition("=")
    if not separator or not name:
        raise ConfigError(f"expected section.key=value, got {text!r}")
    return name.strip(), yaml.safe_load(value)


def _read_preset(name: str) -> dict[str, Any]:
    if name in preset_names():
        text = (resources.files("wm_nodes.config") / "presets" / f"{name}.yaml").read_text()
    elif Path(name).suffix in {".yaml", ".yml"} and Path(name).is_file():
        text = Path(name).read_text()
    else:
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(preset_names())} or give a .yaml file")
    values = yaml.safe_load(text) or {}
    if not isinstance(values, dict):
        raise ConfigError(f"preset {name!r} must be a YAML mapping")
    return values


def _read_task(task: Any) -> dict[str, Any]:
    path = resources.files("wm_nodes.config") / "presets" / f"{TASK_PREFIX}{task}.yaml"
    return (yaml.safe_load(path.read_text()) or {}) if path.is_file() else {}


def _merge(base: dict[str, Any], top: dict[str, Any]) -> None:
    for key, value in top.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict) and key != "behaviours":
            _merge(base[key], value)
        else:
            base[key] = value


def _set_dotted(values: dict[str, Any], dotted: str, value: Any) -> None:
    *parents, last = dotted.split(".")
    section: Any = values
    for name in parents:
        section = section.get(name) if isinstance(section, dict) else None
    if not isinstance(section, dict) or last not in section:
        raise ConfigError(f"unknown setting {dotted!r}; see wm_nodes/config/presets/base.yaml")
    section[last] = value
