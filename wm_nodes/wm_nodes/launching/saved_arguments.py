"""What a run folder was launched with, so that run_dir:=<folder> alone goes on with it.

launch.json holds the arguments of each scenario that was started there; config.yaml, and video_config.yaml of loop 2,
the settings, of which only the device is ever written again.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wm_nodes.config.load import (
    EMBEDDED,
    judge_or_embedded,
    judge_overrides,
    load_config,
    load_video_config,
    parse_override,
    reward_overrides,
)
from wm_nodes.config.saved import DEVICE, Load, differs, load_saved, refuse_differences, with_device
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import read_json
from wm_nodes.launching.scenarios import parse_arguments, scenario_of

FILE = "launch.json"
PRESETS = ("preset", "video_preset")
JUDGE = ("judge", "judge_model", "judge_key_env", "rubric")
SETTINGS = (*PRESETS, "config_file", "task", "set", *JUDGE)
"""Arguments that the saved configuration stands for."""
NOT_KEPT = (
    "run_dir", "allowed_dirs", "domain_id", "discovery_range", "python", "log_level", "executor", "autostart",
    "use_sim_time", "respawn", "memory_limit_gib", "compose",
)
"""Of one start, not of the run."""
FREE = ("namespace", "params_file", "record", "bag_uri", "rate", "train", "keep_buffers", "tensorboard")
"""Kept, and may be given anew."""
FILES = (
    "config_file", "params_file", "model_dir", "starts_file", "first_frames_file", "initial_policy", "video_model_dir",
    "context_bags", "heldout_bags", "bag_uri",
)
ARGUMENT_OF = {
    "rewards": "reward", "judge.kind": "judge", "judge.endpoints": "judge", "judge.folder": "judge",
    "judge.model": "judge_model", "judge.api_key_env": "judge_key_env", "judge.rubric": "rubric",
}
"""Settings that an argument of another name stands for."""


def settings_of(text: str) -> dict[str, Any]:
    """The dotted settings of the argument `set`. Raises ConfigError: a part is not section.key=value."""
    return dict(parse_override(part) for part in text.split(";") if part.strip())


def saved_config(scenario: str, run_dir: Path) -> Path:
    """Where the run folder has the settings of the scenario's loop."""
    return run_dir / ("video_config.yaml" if "video_preset" in scenario_of(scenario).arguments else "config.yaml")


def take_up(scenario: str, given: Mapping[str, str], run_dir: Path) -> dict[str, str]:
    """Return the arguments to go on with: those given, and those that the existing run was launched with.

    Raises:
        ConfigError: given arguments differ from the run's; names each.
    """
    saved, kept = saved_config(scenario, run_dir), read_arguments(run_dir).get(scenario)
    given, before = full_paths(given), {} if kept is None else parse_arguments(scenario, kept)
    settings = SETTINGS if saved.name == "config.yaml" else (*SETTINGS, "reward")
    by_name = {name for name in given if name in before and name not in (*settings, *NOT_KEPT, *FREE)}
    if kept and not kept.get("config_file"):
        by_name |= {*PRESETS} & {*given}
    told = [differs(name, before[name], given[name]) for name in sorted(by_name) if before[name] != given[name]]
    config, more = _compare(saved, given, by_name)
    refuse_differences(run_dir, [*told, *more])
    if given.get("config_file"):
        write_atomic(saved, with_device(saved.read_bytes(), config.device))
    values = {**(kept or {}), **given}
    if kept is None and "seed" in scenario_of(scenario).arguments:
        values.setdefault("seed", str(config.seed))
    return {name: value for name, value in values.items() if name not in settings} | {"config_file": str(saved)}


def _compare(saved: Path, given: Mapping[str, str], by_name: set[str]) -> tuple[Any, list[str]]:
    """The saved configuration, and in what the given settings, of those that were not compared by name, differ."""
    load: Load[Any] = load_config if saved.name == "config.yaml" else load_video_config
    changes = judge_overrides(*(given.get(name, "") for name in JUDGE))
    changes |= settings_of(given.get("set", "")) | ({"task": given["task"]} if given.get("task") else {})
    file = next((given[name] for name in ("config_file", *PRESETS) if given.get(name) and name not in by_name), None)
    file = None if file == str(saved) else file
    if given.get("seed", "").isdigit() and (file or "seed" not in by_name):
        changes["seed"] = int(given["seed"])
    if file is not None and file == given.get("config_file"):
        changes[DEVICE] = load(file, {}).device
    if load is load_video_config:
        changes |= reward_overrides(given.get("reward") or None)
    embedded = load(str(saved), {}).judge.kind == EMBEDDED

    def load_named(file: str, changes: dict[str, Any]) -> Any:
        config = load(file, changes)
        return config.model_copy(update={"judge": judge_or_embedded(config.judge)}) if embedded else config

    return load_saved(load_named, saved, file, changes, ARGUMENT_OF)


def read_arguments(run_dir: Path) -> dict[str, Any]:
    """The arguments of each scenario that was started in a run folder. Raises ModelFolderError for a broken file."""
    path = run_dir / FILE
    return read_json(path, "delete it to go on without it") if path.exists() else {}


def keep_arguments(scenario: str, given: Mapping[str, str], run_dir: Path) -> None:
    """Keep what a scenario was started with."""
    kept = {name: value for name, value in full_paths(given).items() if name not in NOT_KEPT}
    data = json.dumps({**read_arguments(run_dir), scenario: kept}, indent=1) + "\n"
    write_atomic(run_dir / FILE, data.encode())


def full_paths(given: Mapping[str, str]) -> dict[str, str]:
    """The arguments with the full paths of the files that they name, which hold in another working directory too."""
    return {name: _full(name, value) for name, value in given.items()}


def _full(name: str, value: str) -> str:
    parts = value.split(",") if _is_file(name, value) else []
    return ",".join(str(Path(part).expanduser().absolute()) for part in parts if part) or value


def _is_file(name: str, value: str) -> bool:
    if name in (*PRESETS, "rubric"):
        return Path(value).suffix in {".yaml", ".yml"}
    return name in FILES or (name == "judge" and Path(value).is_dir())
