"""Presets: base.yaml holds every number of a loop; task, preset, command line override some of them, in this order.

presets/policy is of loop 1, presets/video of loop 2; the judge of both is in presets/judge.yaml.
"""

import difflib
from collections.abc import Collection, Mapping, Sequence
from copy import deepcopy
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import ValidationError

from wm_nodes.config.environments import TRUTH
from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.schema import AGENT, EXECUTION, RunConfig
from wm_nodes.config.sections import SettingsSection
from wm_nodes.config.tasks import get_task, task_names
from wm_nodes.config.video import VideoRlConfig

PRESETS = resources.files("wm_nodes.config") / "presets"
POLICY, VIDEO = "policy", "video"
"""Folders of presets, one for each loop."""
SCHEMAS: dict[str, type[RunConfig] | type[VideoRlConfig]] = {POLICY: RunConfig, VIDEO: VideoRlConfig}
FREE = ("behaviours", "rewards", "extra_body", "kwargs", "cameras")
"""Mappings without fixed keys, which are replaced as a whole."""
PATHS = ("sft.bags", "judge.folder", "simulation.object_state")
"""Settings that name files or folders."""
RECORD = "run"
"""Section of a run's config.yaml that is no setting: training/run_record.py keeps there what else decides the run."""
EMBEDDED = "embedded"
"""JudgeConfig.kind of the judge in this process."""
REWARDS = ("reference", "closeness", AGENT, EXECUTION)
"""Rewards of the video model: its scores against the recording, how alike both look, a judge's verdicts, or whether the
action world model gets the task done by the clip's motion."""

Config = TypeVar("Config", RunConfig, VideoRlConfig)


class ConfigError(ValueError):
    """A setting or preset that does not exist or is out of range."""


def load_config(preset: str = "cpu", overrides: dict[str, Any] | None = None) -> RunConfig:
    """Return the resolved configuration of loop 1.

    Args:
        preset: a name from preset_names(), or a path of a YAML file of overrides on base.
        overrides: dotted names to values, e.g. {"ppo.updates": 10}.

    Raises:
        ConfigError: names the value, what is allowed, and where to look.
    """
    return _load(RunConfig, POLICY, preset, overrides or {})


def load_video_config(preset: str = "recommended", overrides: dict[str, Any] | None = None) -> VideoRlConfig:
    """Return the resolved configuration of loop 2, as load_config does that of loop 1."""
    return _load(VideoRlConfig, VIDEO, preset, overrides or {})


def _load(schema: type[Config], loop: str, preset: str, overrides: dict[str, Any]) -> Config:
    values = read_preset("base", loop) | read_yaml(PRESETS / "judge.yaml")
    chosen = read_preset(preset, loop)
    task = overrides.get("task", chosen.get("task", values["task"]))
    if loop == POLICY and task in task_names():
        for dotted, value in get_task(task).settings.items():
            _set_dotted(values, dotted, deepcopy(value))
    file = "" if preset in preset_names(loop) else preset
    if preset != "base":
        _merge(values, chosen, file=file)
    for dotted, value in overrides.items():
        _set_dotted(values, dotted, value)
    try:
        return schema.model_validate(values)
    except ValidationError as error:
        raise refusal(error, f"{schema.__module__.replace('.', '/')}.py", file) from None


def reward_overrides(reward: str | None) -> dict[str, Any]:
    """Return the setting of loop 2 for one of REWARDS: the weights of the rewards; {} for None."""
    if reward is None:
        return {}
    return {"rewards": read_preset("base", VIDEO)["rewards"] if reward == "reference" else {reward: 1.0}}


def named_pack(rubric: str) -> str:
    """A rubric pack by its name, or by its file's full path, which holds in another working directory too."""
    return str(Path(rubric).absolute()) if rubric and Path(rubric).is_file() else rubric


def with_full_paths(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted settings, those of PATHS by their full paths, which hold in another working directory too."""
    def full(value: Any) -> Any:
        if isinstance(value, list):
            return [full(part) for part in value]
        is_path = isinstance(value, str) and value not in ("", TRUTH)
        return str(Path(value).expanduser().absolute()) if is_path else value

    return {name: full(value) if name in PATHS else value for name, value in settings.items()}


def judge_overrides(endpoints: str = "", model: str = "", api_key_env: str = "", rubric: str = "") -> dict[str, Any]:
    """Return the dotted settings of the judge for command-line values; empty values set nothing.

    Args:
        endpoints: base URLs, separated by commas; or, for a judge in this process, EMBEDDED or a world-model folder.
        rubric: a pack's name, or a file, from then on by its full path.
    """
    named: dict[str, Any] = {}  # all that says who judges, so that a configuration that says otherwise does not
    if endpoints == EMBEDDED or (endpoints and Path(endpoints).is_dir()):
        named = {"kind": EMBEDDED, "folder": "" if endpoints == EMBEDDED else str(Path(endpoints).absolute())}
    elif urls := [url.strip() for url in endpoints.split(",") if url.strip()]:
        named = {"kind": "openai", "endpoints": urls}
    about = {"model": model, "api_key_env": api_key_env, "rubric": named_pack(rubric)}
    named |= {name: value for name, value in about.items() if value}
    return {f"judge.{name}": value for name, value in named.items()}


def judge_or_embedded(judge: JudgeConfig) -> JudgeConfig:
    """Return the judge's settings; where they name no judge, those of the embedded one, which needs nothing."""
    unnamed = judge.kind != EMBEDDED and not judge.endpoints and not judge.model
    return judge.model_copy(update={"kind": EMBEDDED}) if unnamed else judge


def with_judge(config: Config, reward: str | None = None) -> Config:
    """Where a judge pays, the configuration with the embedded one, if it names none.

    Args:
        reward: what pays in loop 1; loop 2's settings weigh it.
    """
    pays = reward == AGENT or (isinstance(config, VideoRlConfig) and config.rewards.get(AGENT))
    return config.model_copy(update={"judge": judge_or_embedded(config.judge)}) if pays else config


def dump_config(config: SettingsSection) -> str:
    """The resolved configuration as YAML, as saved with every run; its loop's load function reads it back."""
    return str(yaml.safe_dump(config.model_dump(), sort_keys=False))


def split_settings(words: Sequence[str], names: Collection[str] = ()) -> tuple[list[str], dict[str, Any]]:
    """Take the settings out of a command line: `--ppo.updates 10` or `--ppo.updates=10`, the value in YAML.

    Args:
        names: settings without a dot, which are options otherwise.

    Raises:
        ConfigError: a setting without a value, or one that is no YAML.
    """
    rest, settings, left = list[str](), dict[str, Any](), iter(words)
    for word in left:
        option, separator, value = word.partition("=")
        name = option.removeprefix("--")
        if name == option or not ("." in name or name in names):
            rest.append(word)
            continue
        text = value if separator else next(left, None)
        if text is None:
            raise ConfigError(f"expected a value behind {option}")
        settings[name] = parse_value(name, text)
    return rest, settings


def parse_value(name: str, text: str) -> Any:
    """The value of a setting, in YAML, as it is typed. Raises ConfigError."""
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = getattr(error, "problem", None) or error
        raise ConfigError(f"{text!r} of {name} is no YAML: {reason}; quote it if it is text") from None


def preset_names(loop: str = POLICY) -> list[str]:
    """The presets of a loop."""
    return sorted(Path(entry.name).stem for entry in (PRESETS / loop).iterdir() if entry.name.endswith(".yaml"))


def read_preset(name: str, loop: str = POLICY) -> dict[str, Any]:
    """The values of a preset: a name of the loop's, or a path of a YAML file.

    Raises:
        ConfigError: neither of them, or as read_yaml.
    """
    if name in preset_names(loop):
        return read_yaml(PRESETS / loop / f"{name}.yaml")
    if Path(name).suffix not in {".yaml", ".yml"}:
        known = ", ".join(preset_names(loop))
        raise ConfigError(f"unknown preset {name!r}; choose one of {known} or give a .yaml file")
    return {section: values for section, values in read_yaml(Path(name)).items() if section != RECORD}


def _merge(base: dict[str, Any], top: dict[str, Any], path: str = "", file: str = "") -> None:
    """Lay `top`, of a file of the user's, over `base`, in place. Raises ConfigError for a name that base has not."""
    for key, value in top.items():
        if key not in base:
            raise _unknown(f"{path}{key}", base, file)
        if isinstance(value, dict) and isinstance(base[key], dict) and key not in FREE:
            _merge(base[key], value, f"{path}{key}.", file)
        else:
            base[key] = value


def _set_dotted(values: dict[str, Any], dotted: str, value: Any) -> None:
    """Set "section.key" in place; in a free mapping, one entry of it, which may be new. Raises as _merge."""
    *parents, last = dotted.split(".")
    section, path = values, ""
    for name in parents:
        if name not in section:
            raise _unknown(path + name, section)
        section, path = section[name], f"{path}{name}."
        if not isinstance(section, dict):
            raise ConfigError(f"unknown setting {dotted!r}; {path[:-1]} is a single value")
    if parents and parents[-1] in FREE:
        section[last] = value
    else:
        _merge(section, {last: value}, path)


def refusal(error: ValidationError, where: str, file: str = "") -> ConfigError:
    """One error that names every refused value. where: what explains the settings. file: of the user's, with them."""
    refused = []
    for row in error.errors():
        where_in = f"{'.'.join(map(str, row['loc']))}: " if row["loc"] else ""
        text = where_in + row["msg"].removeprefix("Value error, ")
        names_values = row["type"] == "value_error" and not isinstance(row["input"], (str, int, float))
        refused.append(text if names_values else f"{text} (got {row['input']!r})")
    return ConfigError(f"settings{f' in {file}' if file else ''} refused; see {where}: {'; '.join(refused)}")


def _unknown(dotted: str, section: Mapping[str, Any], file: str = "") -> ConfigError:
    """section: what there is where the last name of `dotted` should be."""
    parent, dot, last = dotted.rpartition(".")
    close = difflib.get_close_matches(last, section, n=1)
    hint = f"did you mean {parent + dot + close[0]!r}?" if close else f"known there: {', '.join(section)}"
    return ConfigError(f"unknown setting {dotted!r}{f' in {file}' if file else ''}; {hint}")


def read_yaml(path: Traversable) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises:
        ConfigError: there is none; one line with file, line and remedy.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{path} does not exist; name a .yaml file") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is a folder; name a .yaml file") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}; make it readable, or name another file") from None
    return parse_yaml(data, path)


def parse_yaml(data: bytes, path: object) -> dict[str, Any]:
    """Return the mapping in the bytes of a YAML file. Raises ConfigError: one line with file, line and remedy."""
    line, problem = 1, ""
    try:
        values = yaml.safe_load(data.decode())
        if isinstance(values, dict):
            return values
        if values is None and data.strip():
            return {}  # comments only
        kind = "nothing" if values is None else f"a {type(values).__name__}"
        problem = f"it holds {kind}, not a mapping (name: value)"
    except UnicodeDecodeError as error:
        line, problem = data.count(b"\n", 0, error.start) + 1, "no text (UTF-8)"
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, problem = mark.line + 1 if mark else 1, f"no YAML: {error.problem}"
    except yaml.reader.ReaderError as error:
        line, problem = data.decode().count("\n", 0, error.position) + 1, f"no YAML: {error.reason}"
    except (ValueError, RecursionError) as error:  # of a value, e.g. a date with month 13, or nested too deep
        line, problem = 0, f"no YAML: {error}"
    raise ConfigError(f"{path}{f', line {line}' if line else ''}: {problem}; mend the file, or copy it again")
