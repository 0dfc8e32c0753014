"""Which nodes a scenario has: one table of arguments and one function per scenario.

They serve both `ros2 launch` (launch_description.py) and the plain Python starter (runner.py); no rclpy, no launch, no
files read.
"""

import dataclasses
import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from wm_nodes.config.tasks import task_names
from wm_nodes.launching.graph import Graph, GraphError, NodeSpec, ParameterValue

TRUTHS = ("true", "false")
IMAGINED = ("world_model", "video_model")
"""Environments that a model imagines, which is also where reward `endogenous` comes from."""
PAGE = "page"
"""The argument `view` that starts the viewer."""
REAL = "environment"
"""The environment of environment.factory."""
ENVIRONMENT_TOPICS = ("env/spec", "env/image", "env/transition", "env/goal", "episode")
GRAPH_TOPICS = (
    *ENVIRONMENT_TOPICS, "reward", "action", "policy/version", "reward/summary", "learner/metrics", "run/state",
)
"""What the recorder records of its own namespace: the recorder's default."""
VERDICT_TOPIC = "reward/verdict"
VIDEO_TOPICS = ("clips", "clips/image", "clips/scores", "video/version", VERDICT_TOPIC, "run/state")
AGENT_JOIN_S = 600.0
"""With the reward agent a learner waits so long for the rewards of a rollout: a judge takes its time."""


@dataclass(frozen=True)
class LaunchArgument:
    """One `name:=value` argument."""

    name: str
    """Stands before `:=`."""
    default: str
    """The value where none is given."""
    help: str
    """Without a full stop at its end."""
    choices: tuple[str, ...] = ()
    """Allowed values; empty: any text."""


ARGUMENTS: tuple[LaunchArgument, ...] = (
    LaunchArgument("preset", "", "Settings to start from: a name or a .yaml file, e.g. config.yaml of another run; "
                   "empty: cpu, of the video model recommended"),
    LaunchArgument("task", "", "Task; not given: the preset's; given as empty: none, the spec of the model or the "
                   "environment says everything", ("", *task_names())),
    LaunchArgument("seed", "", "Root seed; empty: the preset's"),
    LaunchArgument("device", "", "Where models compute: cpu, cuda, cuda:N or auto; empty: the preset's"),
    LaunchArgument("run_dir", "", "Folder for settings, weights, bags and logs; an existing one goes on as it was "
                   "begun; empty: runs/<time>-<scenario>"),
    LaunchArgument("allowed_dirs", "", "Folders, separated by colons, where others may name files, beside run_dir"),
    LaunchArgument("namespace", "wm", "ROS namespace of the graph; several graphs on one host need several domains"),
    LaunchArgument("model_dir", "", "World-model folder; empty: the one shipped for the task"),
    LaunchArgument("video_model_dir", "", "Folder of the trained video model"),
    LaunchArgument("context_bags", "", "Bags of contexts for the clips, separated by commas"),
    LaunchArgument("heldout_bags", "", "Bags of held-out contexts, separated by commas; empty: no held-out scores"),
    LaunchArgument("keep_buffers", "4", "Rollout buffers kept in run_dir/buffers; training again needs all of them"),
    LaunchArgument("tensorboard", "false", "Also write the learner's metrics to run_dir/tensorboard", TRUTHS),
    LaunchArgument("starts_file", "", "Frames to imagine from; empty: starts.safetensors in model_dir"),
    LaunchArgument("first_frames_file", "", "First frames with reset seeds, for the exploit meter; empty: starts_file"),
    LaunchArgument("initial_policy", "", "Weights (safetensors) that the policy and the learner start from"),
    LaunchArgument("backend", "world_model", "What the environment node steps; environment: the one of the setting "
                   "environment.factory", (*IMAGINED, REAL)),
    LaunchArgument("params_file", "", "ROS parameter file (YAML) for all nodes; it wins over the other arguments"),
    LaunchArgument("mode", "lockstep", "Who keeps time: the policy's steps, or the environment's clock",
                   ("lockstep", "asynchronous")),
    LaunchArgument("reward", "", "Reward model; empty: endogenous if imagined, else rule; of the video model: what its "
                   "settings weigh; agent: a judge's verdict on whole clips", ("", "endogenous", "rule", "agent")),
    LaunchArgument("judge", "", "reward:=agent: base URLs of the judge's servers with their /v1, separated by commas; "
                   "or the folder of a trained judge; empty, or embedded: the shipped one"),
    LaunchArgument("judge_model", "", "reward:=agent: the judge's name on the server"),
    LaunchArgument("judge_key_env", "", "reward:=agent: environment variable with the server's key; empty: none"),
    LaunchArgument("rubric", "", "reward:=agent: rubric pack, a name or a .yaml file; empty: the settings'"),
    LaunchArgument("num_envs", "0", "Environments stepped together; 0: ppo.num_envs of the configuration"),
    LaunchArgument("simulator_envs", "4", "Environments that the policy is measured in (evaluation.environment)"),
    LaunchArgument("simulator", "true", "Also start them and the evaluation node; not where evaluation.environment "
                   "is none", TRUTHS),
    LaunchArgument("learner_ranks", "1", "Learner processes under torchrun"),
    LaunchArgument("record", "true", "Also start the recorder", TRUTHS),
    LaunchArgument("bag_uri", "", "Bag folder to write or to play; empty: <run_dir>/bags/<scenario>"),
    LaunchArgument("rate", "1.0", "Recorded seconds per second; the learner's pace limits it"),
    LaunchArgument("train", "true", "Train from what is played; false: only play, training waits for a goal", TRUTHS),
    LaunchArgument("executor", "events", "Which rclpy executor spins the nodes", ("events", "single", "multi")),
    LaunchArgument("autostart", "true", "Nodes activate themselves; false: a lifecycle manager does", TRUTHS),
    LaunchArgument("use_sim_time", "false", "Nodes take their time from /clock", TRUTHS),
    LaunchArgument("log_level", "info", "Least severity that nodes log", ("debug", "info", "warn", "error")),
    LaunchArgument("respawn", "false", "A node that ends by itself is started again; false: the graph ends", TRUTHS),
    LaunchArgument("memory_limit_gib", "-1", "Data that each node may hold; 0: no limit; -1: an eighth of the memory, "
                   "at least 3, and no limit where the node computes on a GPU"),
    LaunchArgument("compose", "false", "All nodes in one process: fewer copies, one interpreter", TRUTHS),
    LaunchArgument("view", "", "page: a live page of the graph, which this host alone can open", ("", PAGE)),
    LaunchArgument("view_port", "0", "Of that page; 0: a free one"),
    LaunchArgument("domain_id", "", "ROS domain, 0 to 101; empty: $ROS_DOMAIN_ID, else 0"),
    LaunchArgument(
        "discovery_range", "LOCALHOST", "Who may find the nodes; beyond this host nothing is authenticated",
        ("LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT"),
    ),
    LaunchArgument("python", "", "Interpreter of the nodes; empty: $WM_PYTHON, else the one that starts the graph"),
)
"""Every argument of every scenario: the only place with a default."""

_BY_NAME = {argument.name: argument for argument in ARGUMENTS}
_COMMON = (
    "preset", "task", "seed", "device", "run_dir", "allowed_dirs", "namespace", "executor", "autostart", "use_sim_time",
    "log_level", "respawn", "memory_limit_gib", "compose", "domain_id", "discovery_range", "python", "params_file",
    "view", "view_port",
)


def is_setting(name: str) -> bool:
    """Whether an argument is one of the settings that config/schema.py and config/video.py explain."""
    return "." in name


def parse_arguments(scenario: str, given: Mapping[str, str]) -> dict[str, str]:
    """Return every argument of a scenario with its given or default value; settings are left out.

    Raises:
        GraphError: names the argument and what is allowed.
    """
    names = scenario_of(scenario).arguments
    for name, value in given.items():
        if is_setting(name):
            continue
        if name not in names:
            close = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"it has {', '.join(names)}"
            raise GraphError(f"unknown argument {name!r} of {scenario}; {hint}")
        choices = _BY_NAME[name].choices
        if choices and value not in choices:
            raise GraphError(f"{name} must be one of {', '.join(c or '(empty)' for c in choices)}; got {value!r}")
    return {name: given.get(name, _BY_NAME[name].default) for name in names}


def run_folder(scenario: str, given: Mapping[str, str]) -> Path:
    """The folder that argument run_dir names; where it is empty, a new one of this moment."""
    time = datetime.now().strftime("%Y%m%d-%H%M%S")
    return Path(given.get("run_dir") or f"runs/{time}-{scenario}").expanduser().absolute()


def build_graph(scenario: str, arguments: Mapping[str, str]) -> Graph:
    """Return the graph for resolved arguments, see arguments.begin."""
    graph = scenario_of(scenario).build(arguments)
    if arguments["view"] == PAGE:
        graph = dataclasses.replace(graph, nodes=(*graph.nodes, _viewer(arguments)))
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": arguments["discovery_range"]}
    if arguments["domain_id"]:
        environment["ROS_DOMAIN_ID"] = str(_integer(arguments, "domain_id", 0, 101))
    return dataclasses.replace(graph, environment=environment)


def _number(arguments: Mapping[str, str], name: str, low: float, high: float, kind: type = float) -> Any:
    try:
        value = kind(arguments[name])
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise GraphError(f"{name} must be {what}, got {arguments[name]!r}") from None
    if not low <= value <= high:
        raise GraphError(f"{name} must be {low} to {high}, got {arguments[name]}")
    return value


def _integer(arguments: Mapping[str, str], name: str, low: int, high: int = 2**31) -> int:
    return int(_number(arguments, name, low, high, int))


def _node(
    arguments: Mapping[str, str], name: str, parameters: Mapping[str, ParameterValue], *, below: str = "",
    ranks: int = 1, module: str = "",
) -> NodeSpec:
    """module: of wm_nodes.nodes; empty: the one of the node's name."""
    namespace = "/" + "/".join(part for part in (arguments["namespace"].strip("/"), below) if part)
    common: dict[str, ParameterValue] = {
        "config_file": str(Path(arguments["run_dir"]) / "config.yaml"),
        "run_dir": arguments["run_dir"],
        "autostart": arguments["autostart"] == "true",
        "executor": arguments["executor"],
        "memory_limit_gib": float(_number(arguments, "memory_limit_gib", -1, 1e6)),
        "use_sim_time": arguments["use_sim_time"] == "true",
    }
    if allowed := [folder for folder in arguments["allowed_dirs"].split(":") if folder]:
        common["allowed_dirs"] = allowed
    values = {**common, **parameters}
    return NodeSpec(
        f"wm_nodes.nodes.{module or f'{name}_node'}", name, namespace, values, ranks=ranks,
        respawn=arguments["respawn"] == "true", log_level=arguments["log_level"],
        extra_parameters=arguments["params_file"],
    )


def _environment(arguments: Mapping[str, str], backend: str, *, count: str = "num_envs", below: str = "") -> NodeSpec:
    parameters: dict[str, ParameterValue] = {
        "backend": backend,
        "num_envs": _integer(arguments, count, 1, 4096),
        "seed": _integer(arguments, "seed", 0),
        "mode": arguments.get("mode", "lockstep") if not below else "lockstep",
    }
    if arguments["view"] == PAGE:
        parameters["view_env"] = 0
    if backend in IMAGINED:
        folder = f"{backend.removeprefix('world_')}_dir"
        if not arguments[folder]:
            raise GraphError(f"backend:={backend} needs {folder}:=<folder of a trained one>")
        parameters |= {folder: arguments[folder], "starts_file": arguments["starts_file"]}
    elif folder := arguments.get("model_dir", ""):
        parameters["model_dir"] = folder  # its object reader, where it has one
    return _node(arguments, "environment", parameters, below=below)


def _simulator_and_evaluation(arguments: Mapping[str, str]) -> list[NodeSpec]:
    evaluation = {**_weights(arguments), "env_namespace": "sim"}
    return [
        _environment(arguments, "evaluation", count="simulator_envs", below="sim"),
        _node(arguments, "evaluation", evaluation),
    ]


def _viewer(arguments: Mapping[str, str]) -> NodeSpec:
    node = _node(arguments, "viewer", {"port": _integer(arguments, "view_port", 0, 65535)})
    return dataclasses.replace(node, required=False, lifecycle=False)


def _recorder(arguments: Mapping[str, str], *, simulator: bool = False) -> list[NodeSpec]:
    """simulator: also record the episodes of the environment in namespace sim."""
    if arguments["record"] != "true":
        return []
    more = [f"sim/{name}" for name in ENVIRONMENT_TOPICS] if simulator else []
    more += [VERDICT_TOPIC] if arguments.get("reward") == "agent" else []
    return [_node(arguments, "recorder", {"bag_uri": arguments["bag_uri"], "topics": [*GRAPH_TOPICS, *more]})]


def _weights(arguments: Mapping[str, str]) -> dict[str, ParameterValue]:
    return {name: arguments[name] for name in ("model_dir", "initial_policy")}


def _rollout_nodes(arguments: Mapping[str, str], backend: str, consumers: tuple[str, ...] = ()) -> list[NodeSpec]:
    """consumers: further nodes that must not miss the first messages of a rollout."""
    reward = arguments["reward"] or ("endogenous" if backend in IMAGINED else "rule")
    recorder = _recorder(arguments, simulator=arguments.get("simulator") == "true")
    policy = {**_weights(arguments), "mode": arguments.get("mode", "lockstep")}
    awaited = ["environment", "reward_evaluator", *(node.name for node in recorder), *consumers]
    return [
        _environment(arguments, backend),
        _node(arguments, "reward_evaluator", {"reward": reward, "model_dir": arguments["model_dir"]}),
        _node(arguments, "policy", {**policy, "await_nodes": awaited}),
        *recorder,
    ]


def _online_training(arguments: Mapping[str, str]) -> Graph:
    ranks = _integer(arguments, "learner_ranks", 1, 1024)
    learner = _weights(arguments)
    if arguments["backend"] in IMAGINED:
        learner["starts_file"] = arguments["first_frames_file"] or arguments["starts_file"]
    if arguments["backend"] == "video_model":
        learner["video_model_dir"] = arguments["video_model_dir"]
    if arguments["reward"] == "agent":
        learner["join_timeout_s"] = AGENT_JOIN_S
    rollouts = _rollout_nodes(arguments, arguments["backend"], ("learner",))
    nodes = [*rollouts, _node(arguments, "learner", learner, ranks=ranks)]
    if arguments["simulator"] == "true":
        nodes += _simulator_and_evaluation(arguments)
    return Graph("online_training", tuple(nodes))


def _rollout_record(arguments: Mapping[str, str]) -> Graph:
    return Graph("rollout_record", tuple(_rollout_nodes(arguments, arguments["backend"])))


def _replay_offline(arguments: Mapping[str, str]) -> Graph:
    rate = _number(arguments, "rate", 1e-3, 1e6)
    trains = arguments["train"] == "true"
    player = _node(arguments, "player", {"bag_uri": arguments["bag_uri"], "play_at_start": not trains, "rate": rate})
    source = {"replay_rate": rate, "replay_at_start": arguments["bag_uri"] if trains else ""}
    return Graph("replay_offline", (player, _node(arguments, "learner", {**_weights(arguments), **source})))


def _evaluate(arguments: Mapping[str, str]) -> Graph:
    return Graph("evaluate", (*_simulator_and_evaluation(arguments), *_recorder(arguments, simulator=True)))


def _world_model_rl(arguments: Mapping[str, str]) -> Graph:
    model: dict[str, ParameterValue] = {"video_model_dir": arguments["video_model_dir"]}
    contexts, heldout = (
        [text for text in arguments[name].split(",") if text] for name in ("context_bags", "heldout_bags")
    )
    if not contexts or not arguments["video_model_dir"]:
        raise GraphError("world_model_rl needs video_model_dir:=<folder> and context_bags:=<bag>[,<bag> ...]")
    clips: dict[str, ParameterValue] = {**model, "context_bags": contexts}
    judge: dict[str, ParameterValue] = {"model_dir": arguments["model_dir"]}
    watch: dict[str, ParameterValue] = {**judge, "heldout_bags": heldout} if heldout else {}
    keep = _integer(arguments, "keep_buffers", 1, 100000)
    learner: dict[str, ParameterValue] = {**model, **watch, "tensorboard": arguments["tensorboard"] == "true"}
    if arguments["record"] == "true":
        learner["await_nodes"] = ["recorder"]
    nodes = [
        _node(arguments, "video_model", {**clips, "keep_buffers": keep}),
        _node(arguments, "reward_evaluator", {**clips, **judge}, module="clip_evaluator_node"),
        _node(arguments, "learner", learner, module="video_learner_node"),
    ]
    if arguments["record"] == "true":
        nodes.append(_node(arguments, "recorder", {"bag_uri": arguments["bag_uri"], "topics": list(VIDEO_TOPICS)}))
    return Graph("world_model_rl", tuple(nodes))


def _judge_clips(arguments: Mapping[str, str]) -> Graph:
    parameters = {"reward": "agent", "model_dir": arguments["model_dir"], "audit_dir": "audit"}
    return Graph("judge_clips", (_node(arguments, "reward_evaluator", parameters),))


@dataclass(frozen=True)
class Scenario:
    """A named graph."""

    name: str
    """By which it is launched."""
    summary: str
    """What it is for, one line."""
    arguments: tuple[str, ...]
    """Names in ARGUMENTS, in the order in which --show-args lists them."""
    build: Callable[[Mapping[str, str]], Graph]
    """From resolved arguments, see launching/arguments.py."""
    loop: str = "policy"
    """Whose settings it has: policy or video, as config/load.py says."""


JUDGE = ("judge", "judge_model", "judge_key_env", "rubric")
_TRAINING = (
    *_COMMON, "model_dir", "starts_file", "first_frames_file", "initial_policy", "backend", "video_model_dir",
    "reward", "num_envs", "simulator_envs", "simulator", "learner_ranks", "record", "bag_uri", *JUDGE,
)
_ROLLOUT = (
    "model_dir", "starts_file", "initial_policy", "backend", "video_model_dir", "mode", "reward", "num_envs",
    "record", "bag_uri", *JUDGE,
)
_EVALUATE = (*_COMMON, "model_dir", "initial_policy", "simulator_envs", "record", "bag_uri")

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario("online_training", "Train a policy in an environment; evaluate it in the simulator", _TRAINING,
                 _online_training),
        Scenario("rollout_record", "Let a policy act and record it", (*_COMMON, *_ROLLOUT), _rollout_record),
        Scenario("replay_offline", "Play a bag; the learner trains from what is played",
                 (*_COMMON, "model_dir", "initial_policy", "bag_uri", "rate", "train"), _replay_offline),
        Scenario("evaluate", "Measure a policy in the simulator", _EVALUATE, _evaluate),
        Scenario("world_model_rl", "Post-train the video model by GRPO on clips that it samples",
                 (*(name for name in _COMMON if name != "compose"), "model_dir", "video_model_dir", "context_bags",
                  "heldout_bags", "keep_buffers", "tensorboard", "record", "bag_uri", "reward", *JUDGE),
                 _world_model_rl, "video"),
        Scenario("judge_clips", "Have the reward agent judge folders of clips (action reward/judge_clips)",
                 (*(name for name in _COMMON if name != "compose"), "model_dir", *JUDGE), _judge_clips),
    )
}


def scenario_of(name: str) -> Scenario:
    if name not in SCENARIOS:
        raise GraphError(f"unknown scenario {name!r}; choose one of {', '.join(SCENARIOS)}")
    return SCENARIOS[name]


def describe_arguments(scenario: str) -> str:
    """The text of --show-args."""
    video = scenario_of(scenario).loop == "video"
    lines = [f"{scenario}: {scenario_of(scenario).summary}", "Arguments (name:=value):"]
    for name in scenario_of(scenario).arguments:
        argument = _BY_NAME[name]
        choices = (
            f" One of: {', '.join(choice or '(empty)' for choice in argument.choices)}." if argument.choices else ""
        )
        lines += [f"    {name}:", f"        {argument.help}.{choices} (default: {argument.default!r})"]
    example, verb = ("grpo.clip:=0.1", "train-video-model") if video else ("ppo.num_envs:=8", "train-policy")
    lines += ["    SECTION.KEY:", f"        Any setting, e.g. {example}; `wm {verb} --help` explains each"]
    return "\n".join(lines)


def argument_table(scenario: str) -> list[LaunchArgument]:
    return [_BY_NAME[name] for name in scenario_of(scenario).arguments]
