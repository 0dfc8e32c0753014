"""Presets: base.yaml holds every number; task, preset and command line override some of them, in this order.

Reading presets and laying values over one another serve the settings of loop 2 too (video_rl/settings.py).
"""

from collections.abc import Collection
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from wm_nodes.config.schema import JudgeConfig, RunConfig

PRESETS = "presets"
TASK_PREFIX = "task_"
"""presets/task_<name>.yaml holds what differs between tasks; it lies between base and the preset."""
FREE = ("behaviours",)
EMBEDDED = "embedded"
"""JudgeConfig.kind of the judge in this process."""


class ConfigError(ValueError):
    """A setting or preset that does not exist or is out of range."""


def load_config(preset: str = "cpu", overrides: dict[str, Any] | None = None) -> RunConfig:
    """Return the resolved configuration.

    Args:
        preset: a name from preset_names(), or a path of a YAML file of overrides on base.
        overrides: dotted names to values, e.g. {"ppo.updates": 10}.

    Raises:
        ConfigError: names the value, what is allowed, and where to look.
    """
    values = read_preset("base")
    chosen = read_preset(preset)
    task = (overrides or {}).get("task", chosen.get("task", values["task"]))
    merge(values, _read_task(task), FREE)
    if preset != "base":
        merge(values, chosen, FREE)
    for dotted, value in (overrides or {}).items():
        set_dotted(values, dotted, value, FREE)
    try:
        return RunConfig.model_validate(values)
    except ValidationError as error:
        raise refusal(error, "wm_nodes/config/schema.py") from None


def default_judge() -> JudgeConfig:
    """The judge's settings of base.yaml, which loop 2 has too (video_rl/settings.py)."""
    return JudgeConfig.model_validate(read_preset("base")["judge"])


def named_pack(rubric: str) -> str:
    """A rubric pack by its name, or by its file's full path, which holds in another working directory too."""
    return str(Path(rubric).absolute()) if rubric and Path(rubric).is_file() else rubric


def judge_overrides(endpoints: str = "", model: str = "", api_key_env: str = "", rubric: str = "") -> dict[str, Any]:
    """The dotted settings that a user's words for the judge stand for; empty words stand for none.

    Args:
        endpoints: base URLs, separated by commas; EMBEDDED, or the folder of a trained judge, for one without a server.
        rubric: a pack's name, or a file, from then on by its full path.
    """
    here: dict[str, str] = {}
    if endpoints == EMBEDDED or (endpoints and Path(endpoints).is_dir()):
        here = {"kind": EMBEDDED, "folder": "" if endpoints == EMBEDDED else str(Path(endpoints).absolute())}
    urls = [] if here else [url.strip() for url in endpoints.split(",") if url.strip()]
    found = {"endpoints": urls, "model": model, "api_key_env": api_key_env, "rubric": named_pack(rubric), **here}
    return {f"judge.{name}": value for name, value in found.items() if value}


def judge_or_embedded(judge: JudgeConfig) -> JudgeConfig:
    """The judge's settings; where they name nobody, those of the embedded judge, which needs nothing."""
    nobody = judge.kind != EMBEDDED and not judge.endpoints and not judge.model
    return judge.model_copy(update={"kind": EMBEDDED}) if nobody else judge


def dump_config(config: RunConfig) -> str:
    """The resolved configuration as YAML, as saved with every run."""
    return str(yaml.safe_dump(config.model_dump(), sort_keys=False))


def parse_override(text: str) -> tuple[str, Any]:
    """Split `section.key=value` from the command line; the value is read as YAML."""
    name, separator, value = text.partition("=")
    if not separator or not name:
        raise ConfigError(f"expected section.key=value, got {text!r}")
    return name.strip(), yaml.safe_load(value)


def preset_names(folder: str = PRESETS) -> list[str]:
    """The presets in a folder of wm_nodes/config; what only differs by task is none."""
    entries = (resources.files("wm_nodes.config") / folder).iterdir()
    names = (Path(entry.name).stem for entry in entries if entry.name.endswith(".yaml"))
    return sorted(name for name in names if not name.startswith(TASK_PREFIX))


def read_preset(name: str, folder: str = PRESETS) -> dict[str, Any]:
    """The values of a preset: a name of `folder`, or a path of a YAML file.

    Raises:
        ConfigError: neither of them, or no mapping.
    """
    if name in preset_names(folder):
        text = (resources.files("wm_nodes.config") / folder / f"{name}.yaml").read_text()
    elif Path(name).suffix in {".yaml", ".yml"} and Path(name).is_file():
        text = Path(name).read_text()
    else:
        known = ", ".join(preset_names(folder))
        raise ConfigError(f"unknown preset {name!r}; choose one of {known} or give a .yaml file")
    values = yaml.safe_load(text) or {}
    if not isinstance(values, dict):
        raise ConfigError(f"preset {name!r} must be a YAML mapping")
    return values


def merge(base: dict[str, Any], top: dict[str, Any], free: Collection[str] = (), path: str = "") -> None:
    """Lay `top` over `base`, in place. free: names of mappings without fixed keys, which are replaced as a whole.

    Raises:
        ConfigError: a name that base does not have.
    """
    for key, value in top.items():
        if key not in base:
            raise _unknown(f"{path}{key}", base)
        if isinstance(value, dict) and isinstance(base[key], dict) and key not in free:
            merge(base[key], value, free, f"{path}{key}.")
        else:
            base[key] = value


def set_dotted(values: dict[str, Any], dotted: str, value: Any, free: Collection[str] = ()) -> None:
    """Set "section.key" in place; in a free mapping, one entry of it, which may be new.

    Raises:
        ConfigError: there is no such setting.
    """
    *parents, last = dotted.split(".")
    section, path = values, ""
    for name in parents:
        if name not in section:
            raise _unknown(path + name, section)
        section, path = section[name], f"{path}{name}."
        if not isinstance(section, dict):
            raise ConfigError(f"unknown setting {dotted!r}; {path[:-1]} is a single value")
    if parents and parents[-1] in free:
        section[last] = value
    else:
        merge(section, {last: value}, free, path)


def refusal(error: ValidationError, where: str) -> ConfigError:
    """One error that names every refused value. where: the file that explains the settings."""
    lines = [f"  {'.'.join(map(str, e['loc']))}: {e['msg']} (got {e['input']!r})" for e in error.errors()]
    return ConfigError(f"settings refused; see {where}:\n" + "\n".join(lines))


def _unknown(dotted: str, section: dict[str, Any]) -> ConfigError:
    return ConfigError(f"unknown setting {dotted!r}; known there: {', '.join(map(str, section))}")


def _read_task(task: Any) -> dict[str, Any]:
    path = resources.files("wm_nodes.config") / PRESETS / f"{TASK_PREFIX}{task}.yaml"
    return (yaml.safe_load(path.read_text()) or {}) if path.is_file() else {}
