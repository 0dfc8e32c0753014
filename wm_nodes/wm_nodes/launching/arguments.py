"""From given launch arguments to a graph on disk: run folder, configuration, model; shared by both starters.

`python -m wm_nodes.launching.arguments <scenario>`: arguments as JSON on stdin, the graph as JSON on stdout.
"""

import json
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from wm_nodes.config.environments import NO_ENVIRONMENT
from wm_nodes.config.load import (
    dump_config,
    judge_or_embedded,
    judge_overrides,
    load_config,
    load_video_config,
    read_yaml,
    reward_overrides,
)
from wm_nodes.config.schema import AGENT, JudgeConfig, RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.files import write_atomic
from wm_nodes.launching.graph import Graph, GraphError, compose
from wm_nodes.launching.saved_arguments import (
    full_paths,
    keep_arguments,
    read_arguments,
    saved_config,
    settings_of,
    take_up,
)
from wm_nodes.launching.scenarios import IMAGINED, REAL, build_graph, parse_arguments, run_folder


def resolve(scenario: str, given: Mapping[str, str], now: datetime | None = None) -> dict[str, str]:
    """Fill what depends on this machine and moment: run_dir (made), config_file (written), model, bag, counts.

    Raises:
        GraphError: for an unknown argument or value, and where no model is known.
        ConfigError: for a wrong preset or setting.
    """
    values = parse_arguments(scenario, given)
    values |= {"reward": "agent"} if scenario == "judge_clips" else {}
    run_dir = run_folder(scenario, values, now)
    values["run_dir"] = str(run_dir)
    if values["params_file"]:
        values["params_file"] = _check_params(values["params_file"])
    allowed = [str(Path(folder).expanduser().absolute()) for folder in values["allowed_dirs"].split(":") if folder]
    allowed += [str(Path(values["bag_uri"]).expanduser().absolute())] if scenario == "replay_offline" else []
    values["allowed_dirs"] = ":".join(allowed)  # the bag that the user names is one for goals, too
    given_config = values["config_file"]
    changes = _judge_settings(values) | settings_of(values.get("set", ""))
    if "video_preset" in values:
        return _resolve_video(values, run_dir, changes)
    if given_config and changes:
        raise GraphError(f"config_file is given, so {', '.join(changes)} belong into it; leave these arguments out")
    if given_config:
        values["config_file"] = str(Path(given_config).expanduser().absolute())
        config = load_config(values["config_file"])
    else:
        seed = values.get("seed", "")
        config = load_config(
            values["preset"], {"task": values["task"]} | ({"seed": int(seed)} if seed.isdigit() else {}) | changes
        )
        if values.get("reward") == "agent":
            config = config.model_copy(update={"judge": judge_or_embedded(config.judge)})
        values["config_file"] = str(run_dir / "config.yaml")
    if values.get("reward") == "agent":
        _check_agent(config, values)
    if values.get("num_envs") == "0":
        values["num_envs"] = str(config.ppo.num_envs)
    if config.evaluation.environment == NO_ENVIRONMENT and "simulator" in values:
        values["simulator"] = "false"
    if "model_dir" in values and (values["model_dir"] or config.task or values.get("backend") in IMAGINED):
        values["model_dir"] = _model_dir(values["model_dir"], config.task)
    if values.get("starts_file") == "" and values["model_dir"]:
        values["starts_file"] = str(Path(values["model_dir"]) / "starts.safetensors")
    if "bag_uri" in values:
        values["bag_uri"] = _bag_uri(values["bag_uri"], scenario, run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    if not given_config:
        write_atomic(Path(values["config_file"]), dump_config(config).encode())
    return values


def _judge_settings(values: Mapping[str, str]) -> dict[str, Any]:
    """The settings that the judge's arguments stand for. Raises GraphError where nobody would be asked by them."""
    settings = judge_overrides(*(values.get(name, "") for name in ("judge", "judge_model", "judge_key_env", "rubric")))
    if settings and values["reward"] != "agent":
        raise GraphError(f"{', '.join(settings)} would change nothing without reward:=agent")
    return settings


def _check_agent(config: RunConfig, values: Mapping[str, str]) -> None:
    """Before a policy's episodes are judged. A backend of the user's may make images that the settings do not know, and
    clips in a folder have any size."""
    from wm_nodes.judge.episode_reward import check_agent

    _check_judge(config.judge)
    if values.get("backend") != REAL and "num_envs" in values:
        try:
            check_agent(config, trains="learner_ranks" in values)
        except ValueError as error:
            raise GraphError(str(error)) from None


def _check_judge(settings: JudgeConfig) -> None:
    from wm_nodes.judge.backends.factory import check_judge

    try:
        check_judge(settings)
    except ValueError as error:
        raise GraphError(f"{error}; as arguments: judge:=<url> judge_model:=<name>") from None


def _resolve_video(values: dict[str, str], run_dir: Path, changes: dict[str, Any]) -> dict[str, str]:
    """Loop 2 has settings of its own (config/video.py); the world model gives the judge's position probe."""

    if values["reward"] not in ("", "agent"):
        raise GraphError(f"reward {values['reward']!r} is of policies; for the video model give agent or nothing")
    weights = reward_overrides(values["reward"] or None)
    config = load_video_config(values["config_file"] or values["video_preset"], {**weights, **changes})
    if config.rewards.get(AGENT):
        config = config.with_values(judge=judge_or_embedded(config.judge))
        _check_judge(config.judge)
    values["model_dir"] = _model_dir(values["model_dir"], config.task)
    values["bag_uri"] = _bag_uri(values["bag_uri"], "world_model_rl", run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    if values["config_file"] != (saved := str(run_dir / "video_config.yaml")):
        write_atomic(Path(saved), dump_config(config).encode())
    return {**values, "config_file": saved}


def begin(scenario: str, given: Mapping[str, str]) -> tuple[Graph, dict[str, str]]:
    """prepare() for a person's command: an existing run folder goes on with its settings and arguments.

    Args:
        given: the arguments that were given, without any defaults.

    Raises:
        As resolve(); ConfigError: given arguments differ from the run's.
    """
    parse_arguments(scenario, given)
    run_dir = run_folder(scenario, given)
    saved = saved_config(scenario, run_dir)
    if saved.exists():
        values = take_up(scenario, given, run_dir)
        return prepare(scenario, values, {**read_arguments(run_dir).get(scenario, values), **given})
    try:
        values = full_paths(given)
        if values.get("config_file") and saved.name == "config.yaml":
            write_atomic(saved, dump_config(load_config(values["config_file"])).encode())
            values["config_file"] = str(saved)
        return prepare(scenario, values, given)
    except BaseException:
        saved.unlink(missing_ok=True)  # nothing has begun
        raise


def prepare(
    scenario: str, given: Mapping[str, str], kept: Mapping[str, str] | None = None
) -> tuple[Graph, dict[str, str]]:
    """Return the graph to start and its resolved arguments; graph.json in the run folder keeps a copy for people.

    kept: the arguments by which the run folder will be known; None: those given.
    """
    values = resolve(scenario, given)
    graph = build_graph(scenario, values)
    if values.get("compose") == "true":
        graph = compose(graph, str(Path(values["run_dir"]) / "composed.params.yaml"))
        for node in graph.nodes:
            if node.inside:
                Path(node.parameter_file).write_text(node.carried_parameters(), encoding="utf-8")
    (Path(values["run_dir"]) / "graph.json").write_text(graph.to_json(), encoding="utf-8")
    keep_arguments(scenario, given if kept is None else kept, Path(values["run_dir"]))
    return graph, values


def _model_dir(given: str, task: str) -> str:
    if given:
        folder = Path(given).expanduser().absolute()
        if not (folder / "manifest.json").is_file():
            raise GraphError(
                f"model_dir {str(folder)!r} holds no manifest.json; give the folder of a trained world model"
            )
        return str(folder)
    try:
        return str(shipped_model(task))
    except FileNotFoundError as error:
        raise GraphError(str(error)) from None


def _check_params(given: str) -> str:
    path = Path(given).expanduser().absolute()
    if not path.exists():
        raise GraphError(f"params_file {given!r} does not exist")
    read_yaml(path)
    return str(path)


def _bag_uri(given: str, scenario: str, run_dir: Path) -> str:
    if scenario == "replay_offline":
        if not given:
            raise GraphError("replay_offline needs bag_uri:=<folder of a recorded bag>")
        if not Path(given).expanduser().exists():
            raise GraphError(f"bag_uri {given!r} does not exist")
    return str(Path(given).expanduser().absolute()) if given else str(run_dir / "bags" / scenario)


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
