"""From given launch arguments to a graph: run folder, configuration, model; shared by both starters.

`python -m wm_nodes.launching.arguments <scenario>`: arguments as JSON on stdin, the graph as JSON on stdout.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wm_nodes.config.environments import NO_ENVIRONMENT
from wm_nodes.config.load import (
    VIDEO,
    judge_overrides,
    load_config,
    load_video_config,
    parse_value,
    read_yaml,
    reward_overrides,
    with_full_paths,
    with_judge,
)
from wm_nodes.config.schema import AGENT, RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.launching.graph import Graph, GraphError, compose
from wm_nodes.launching.scenarios import (
    IMAGINED,
    JUDGE,
    PAGE,
    REAL,
    argument_table,
    build_graph,
    is_setting,
    parse_arguments,
    run_folder,
    scenario_of,
)
from wm_nodes.reports.live_page import free_port
from wm_nodes.training.run_record import PRESET, Starter, take_up

OF_ONE_START = (
    "run_dir", "allowed_dirs", "domain_id", "discovery_range", "python", "log_level", "executor", "autostart",
    "use_sim_time", "respawn", "memory_limit_gib", "compose", "view", "view_port",
)
"""Arguments that a run does not keep."""
FREE = ("namespace", "params_file", "record", "bag_uri", "rate", "train", "keep_buffers", "tensorboard")
"""Arguments that are kept and may be given anew."""
SETTINGS = ("task", "seed", "device", *JUDGE)
"""Arguments that stand for settings; in loop 2 `reward` does, too."""
ARGUMENT_OF = {
    "rewards": "reward", "judge.kind": "judge", "judge.endpoints": "judge", "judge.folder": "judge",
    "judge.model": "judge_model", "judge.api_key_env": "judge_key_env", "judge.rubric": "rubric",
}
"""Arguments of another name than the settings that they stand for."""
FILES = (
    "params_file", "model_dir", "starts_file", "first_frames_file", "initial_policy", "video_model_dir",
    "context_bags", "heldout_bags", "bag_uri",
)


def begin(scenario: str, given: Mapping[str, str]) -> tuple[Graph, dict[str, str]]:
    """Return the graph of a person's command, and its resolved arguments; an existing run folder goes on with its own.

    Args:
        given: the arguments that were given, without defaults; settings also as `section.key`.

    Raises:
        GraphError: for an unknown argument or value, and where no model is known.
        ConfigError: for a wrong preset or setting, or what differs from the run's.
    """
    return _make(scenario, given, compare=True)


def prepare(scenario: str, given: Mapping[str, str]) -> tuple[Graph, dict[str, str]]:
    """begin() for a command that answers for its run folder: nothing is compared with what was started there before."""
    return _make(scenario, given, compare=False)


def _make(scenario: str, given: Mapping[str, str], *, compare: bool) -> tuple[Graph, dict[str, str]]:
    parse_arguments(scenario, given)
    run_dir = run_folder(scenario, given)
    given = {name: _full_paths(name, value) for name, value in given.items() if value or name != PRESET}
    starter, settings = _starter(scenario), _settings(scenario, given)
    kept = {name: value for name, value in given.items() if name in {**starter.fixed, **starter.free}}
    config, options, record = take_up(run_dir, starter, kept, settings, compare=compare)
    of_start = {name: value for name, value in given.items() if name in OF_ONE_START}
    values = parse_arguments(scenario, {**options, **of_start, "run_dir": str(run_dir)})
    _check_used(given, values)
    _check_judge(scenario, values, config, settings)
    values = _resolve(scenario, values, config)
    graph = build_graph(scenario, values)
    if values.get("compose") == "true":
        graph = compose(graph, str(run_dir / "composed.params.yaml"))
    record.write(run_dir)
    for node in graph.nodes:
        if node.inside:
            Path(node.parameter_file).write_text(node.carried_parameters(), encoding="utf-8")
    return graph, values


def _starter(scenario: str) -> Starter[Any]:
    video = scenario_of(scenario).loop == VIDEO
    of_settings = (*SETTINGS, "reward") if video else SETTINGS
    defaults = {argument.name: argument.default for argument in argument_table(scenario)}
    fixed = {name: default for name, default in defaults.items() if name not in (*OF_ONE_START, *FREE, *of_settings)}
    fixed[PRESET] = "recommended" if video else "cpu"
    free = {name: default for name, default in defaults.items() if name in FREE}

    def load(file: str, settings: dict[str, Any], options: Mapping[str, str]) -> RunConfig | VideoRlConfig:
        if video:
            return with_judge(load_video_config(file, settings))
        return with_judge(load_config(file, settings), _reward(scenario, options))

    return Starter(scenario, load, fixed, free, ARGUMENT_OF, joins=True)


def _settings(scenario: str, given: Mapping[str, str]) -> dict[str, Any]:
    """The dotted settings that the arguments stand for."""
    typed = [name for name, value in given.items() if is_setting(name) or (name == "seed" and value)]
    settings = with_full_paths({name: parse_value(name, given[name]) for name in typed})
    settings |= {name: given[name] for name in ("task", "device") if name in given and (given[name] or name == "task")}
    settings |= judge_overrides(*(given.get(name, "") for name in JUDGE))
    if scenario_of(scenario).loop == VIDEO and (reward := given.get("reward")):
        if reward != AGENT:
            raise GraphError(f"reward {reward!r} is of policies; for the video model give agent or nothing")
        settings = reward_overrides(reward) | settings  # a weight of one that is given by name wins
    return settings


def _reward(scenario: str, options: Mapping[str, str]) -> str | None:
    return AGENT if scenario == "judge_clips" else options.get("reward")


def _check_used(given: Mapping[str, str], values: Mapping[str, str]) -> None:
    """Raise GraphError for an argument that another one would have to be given with."""
    for name, other, value in (("video_model_dir", "backend", "video_model"), ("view_port", "view", PAGE)):
        if given.get(name, "0") not in ("", "0") and values.get(other, value) != value:
            raise GraphError(f"{name} would change nothing without {other}:={value}")


def _check_judge(
    scenario: str, values: Mapping[str, str], config: RunConfig | VideoRlConfig, settings: Mapping[str, Any]
) -> None:
    """Raise GraphError where a judge is named that nobody asks, or one is needed that cannot judge.

    A backend of the user's may make images that the settings do not know, and clips in a folder have any size.
    """
    from wm_nodes.judge.backends.factory import check_judge
    from wm_nodes.judge.episode_reward import check_agent

    pays = _reward(scenario, values) == AGENT if isinstance(config, RunConfig) else config.rewards.get(AGENT)
    named = [name for name in settings if name.startswith("judge.")]
    if not pays:
        if named and "judge" in values:
            raise GraphError(f"{', '.join(named)} would change nothing without reward:=agent")
        return
    try:
        check_judge(config.judge)
    except ValueError as error:
        raise GraphError(f"{error}; as arguments: judge:=<url> judge_model:=<name>") from None
    if isinstance(config, RunConfig) and values.get("backend") != REAL and "num_envs" in values:
        try:
            check_agent(config, trains="learner_ranks" in values)
        except ValueError as error:
            raise GraphError(str(error)) from None


def _resolve(scenario: str, values: Mapping[str, str], config: RunConfig | VideoRlConfig) -> dict[str, str]:
    """Fill what follows from the configuration and this machine: seed, counts, model, frames, bag, allowed folders."""
    allowed = [str(Path(folder).expanduser().absolute()) for folder in values["allowed_dirs"].split(":") if folder]
    filled = {**values, "seed": str(config.seed)}
    if values["params_file"]:
        _check_params(values["params_file"])
    if values["view"] == PAGE:
        filled["view_port"] = free_port(values["view_port"])
    if isinstance(config, RunConfig):
        if values.get("num_envs") == "0":
            filled["num_envs"] = str(config.ppo.num_envs)
        if config.evaluation.environment == NO_ENVIRONMENT and "simulator" in values:
            filled["simulator"] = "false"
    if "model_dir" in values and (values["model_dir"] or config.task or values.get("backend") in IMAGINED):
        filled["model_dir"] = _model_dir(values["model_dir"], config.task)
    if values.get("starts_file") == "" and filled["model_dir"]:
        filled["starts_file"] = str(Path(filled["model_dir"]) / "starts.safetensors")
    if scenario == "replay_offline":
        _check_played(values["bag_uri"])
        allowed.append(values["bag_uri"])  # the bag that the user names is one for goals, too
    elif values.get("bag_uri") == "":
        filled["bag_uri"] = str(Path(values["run_dir"]) / "bags" / scenario)
    return {**filled, "allowed_dirs": ":".join(allowed)}


def _model_dir(given: str, task: str) -> str:
    if given:
        if not Path(given, "manifest.json").is_file():
            raise GraphError(
                f"model_dir {given!r} holds no manifest.json; give the folder of a trained world model as model_dir:=, "
                "also where this run's was moved"
            )
        return given
    try:
        return str(shipped_model(task))
    except FileNotFoundError as error:
        raise GraphError(str(error)) from None


def _check_params(path: str) -> None:
    if not Path(path).exists():
        raise GraphError(f"params_file {path!r} does not exist")
    read_yaml(Path(path))


def _check_played(bag: str) -> None:
    if not bag:
        raise GraphError("replay_offline needs bag_uri:=<folder of a recorded bag>")
    if not Path(bag).exists():
        raise GraphError(f"bag_uri {bag!r} does not exist")


def _full_paths(name: str, value: str) -> str:
    """An argument with the full paths of the files that it names, which hold in another working directory too."""
    if name in (PRESET, "rubric"):
        is_file = Path(value).suffix in {".yaml", ".yml"}
    else:
        is_file = name in FILES or (name == "judge" and Path(value).is_dir())
    return ",".join(str(Path(part).expanduser().absolute()) for part in value.split(",") if part) if is_file else value


def main() -> int:
    try:
        graph, _ = begin(sys.argv[1], json.load(sys.stdin))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(graph.to_json())
    return 0


if __name__ == "__main__":
    sys.exit(main())
