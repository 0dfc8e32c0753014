"""Scenarios as data, and that both faces of a launch file start the same processes."""

import ast
import importlib.util
import json
import sys
import types
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from run_holders import holder

from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching import launch_description as launch_face
from wm_nodes.launching.domain_lock import DomainInUseError, DomainLock
from wm_nodes.launching.environment import graph_environment
from wm_nodes.launching.graph import Graph, GraphError, NodeSpec
from wm_nodes.launching.runner import Runner, main
from wm_nodes.launching.scenarios import (
    ARGUMENTS,
    SCENARIOS,
    describe_arguments,
    parse_arguments,
)
from wm_nodes.reports.live_page import LivePage, free_port
from wm_nodes.ros.middleware import PROFILE
from wm_nodes.training.run_lock import RunFolderInUseError
from wm_nodes.training.run_record import read_record
from wm_nodes.world_model import load_starts

FILES: list[tuple[str, dict[str, str]]] = [
    *((scenario, {}) for scenario in SCENARIOS), ("online_training", {"compose": "true", "respawn": "true"}),
    ("online_training", {"view": "page"}),
]
"""Every launch file as it starts by default, the one whose nodes may share a process, and one that is looked at."""


@pytest.fixture
def given(tmp_path: Path) -> dict[str, str]:
    """Arguments with a model folder and a bag, for every scenario that takes them."""
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "manifest.json").write_text("{}")
    (tmp_path / "bag").mkdir()
    return {
        "run_dir": str(tmp_path / "run"), "model_dir": str(tmp_path / "model"), "bag_uri": str(tmp_path / "bag"),
        "preset": "smoke", "domain_id": "7", "video_model_dir": str(tmp_path / "model"),
        "context_bags": f"{tmp_path / 'bag'},{tmp_path / 'bag'}",
    }


def of(scenario: str, given: dict[str, str]) -> dict[str, str]:
    left_out = () if SCENARIOS[scenario].loop == "video" else ("video_model_dir",)
    return {name: given[name] for name in given if name in {*SCENARIOS[scenario].arguments} - {*left_out}}


def labels(scenario: str, given: dict[str, str], **more: str) -> list[str]:
    own = {"run_dir": f"{given['run_dir']}/{scenario}"}
    graph, _ = launch_arguments.prepare(scenario, {**of(scenario, given), **own, **more})
    return [node.label for node in graph.nodes]


def test_each_scenario_has_the_nodes_that_its_summary_promises(given: dict[str, str]) -> None:
    training = ["wm/environment", "wm/reward_evaluator", "wm/policy", "wm/recorder", "wm/learner"]
    simulator = ["wm/sim/environment", "wm/evaluation"]
    assert labels("online_training", given) == training + simulator
    assert labels("online_training", given, simulator="false", record="false") == [
        name for name in training if name != "wm/recorder"
    ]
    assert labels("rollout_record", given) == training[:4]
    assert labels("replay_offline", given) == ["wm/player", "wm/learner"]
    assert labels("evaluate", given) == [*simulator, "wm/recorder"]
    assert labels("world_model_rl", given) == ["wm/video_model", "wm/reward_evaluator", "wm/learner", "wm/recorder"]
    assert labels("online_training", given, compose="true") == ["wm/composed", "wm/sim/environment"]
    for scenario in SCENARIOS:
        assert labels(scenario, given, view="page")[-1] == "wm/viewer"
    assert labels("evaluate", given, namespace="/lab/two", compose="false")[0] == "lab/two/sim/environment"


@pytest.mark.parametrize(("scenario", "compose"), FILES)
def test_every_node_module_and_its_ros2_run_name_exist(
    scenario: str, compose: dict[str, str], given: dict[str, str], repository: Path
) -> None:
    setup = ast.parse((repository / "wm_nodes" / "setup.py").read_text())
    names = next(ast.literal_eval(n.value) for n in setup.body if isinstance(n, ast.Assign))
    graph, _ = launch_arguments.prepare(scenario, of(scenario, given) | compose)
    for node in graph.nodes:
        assert importlib.util.find_spec(node.module) is not None, node.module
        assert node.name in (*names, "composed")


@pytest.mark.parametrize(
    "scenario", ["online_training", "rollout_record", "replay_offline", "evaluate", "world_model_rl"]
)
def test_nodes_get_only_parameters_that_they_declare(scenario: str, given: dict[str, str]) -> None:
    """Nodes refuse unknown parameters."""
    graph, _ = launch_arguments.prepare(scenario, of(scenario, given) | {"view": "page"})
    common = {"config_file", "run_dir", "allowed_dirs", "autostart", "executor", "memory_limit_gib", "use_sim_time"}
    for node in graph.nodes:
        declared = {param.name for param in importlib.import_module(node.module).PARAMS}
        assert set(node.parameters) - common <= declared, node.label


def test_folders_that_the_user_allows_and_the_bag_that_is_replayed_go_to_every_node(given: dict[str, str]) -> None:
    bag, values = given["bag_uri"], of("replay_offline", given)
    for more, allowed in (({}, [bag]), ({"allowed_dirs": "/data:~/x"}, ["/data", str(Path("~/x").expanduser()), bag])):
        graph, _ = launch_arguments.prepare("replay_offline", values | more)
        assert [node.parameters["allowed_dirs"] for node in graph.nodes] == [allowed, allowed]
    graph, _ = launch_arguments.prepare("online_training", of("online_training", given) | {"allowed_dirs": "/data"})
    assert {tuple(node.parameters["allowed_dirs"]) for node in graph.nodes} == {("/data",)}
    assert "-p" in (words := graph.nodes[0].parameter_arguments()) and 'allowed_dirs:=["/data"]' in words
    graph, _ = launch_arguments.prepare("online_training", of("online_training", given))
    assert all("allowed_dirs" not in node.parameters for node in graph.nodes)


def test_held_out_bags_and_their_judge_go_to_the_learner_of_loop_2_and_none_where_none_are_named(
    given: dict[str, str],
) -> None:
    values = of("world_model_rl", given)
    graph, _ = launch_arguments.prepare("world_model_rl", values)
    assert "heldout_bags" not in graph.node("learner").parameters
    more = {"heldout_bags": "/a,/b", "keep_buffers": "30", "tensorboard": "true"}
    graph, _ = launch_arguments.prepare("world_model_rl", values | more)
    learner = graph.node("learner").parameters
    assert learner["heldout_bags"] == ["/a", "/b"] and learner["model_dir"] == given["model_dir"]
    assert learner["tensorboard"] is True
    assert graph.node("video_model").parameters["keep_buffers"] == 30
    with pytest.raises(GraphError, match="keep_buffers must be 1 to 100000, got 0"):
        launch_arguments.prepare("world_model_rl", values | {"keep_buffers": "0"})


def test_configuration_of_the_run_is_written_and_sets_the_number_of_environments(given: dict[str, str]) -> None:
    graph, values = launch_arguments.prepare("online_training", of("online_training", given) | {"task": "reach"})
    parameters = graph.node("wm/environment").parameters
    assert parameters["config_file"] == f"{values['run_dir']}/config.yaml" and parameters["num_envs"] == 8
    assert "task: reach" in Path(values["run_dir"], "config.yaml").read_text()


def test_composed_process_carries_the_nodes_of_the_namespace_with_their_own_parameters(given: dict[str, str]) -> None:
    graph, _ = launch_arguments.prepare("online_training", of("online_training", given) | {"compose": "true"})
    process = graph.node("wm/learner")
    assert process.name == "composed" and graph.node("policy") is process
    names = "environment reward_evaluator policy recorder learner evaluation"
    assert process.program() == ["-m", "wm_nodes.nodes.compose", *names.split()]
    arguments = process.ros_arguments()
    parameters = json.loads(Path(arguments[arguments.index("--params-file") + 1]).read_text())
    assert parameters["/wm/environment"]["ros__parameters"]["num_envs"] == 8
    assert parameters["/wm/evaluation"]["ros__parameters"]["env_namespace"] == "sim"
    assert not any("__node" in argument for argument in arguments)


def test_the_learner_knows_what_is_imagined_from_for_its_exploit_meter(given: dict[str, str]) -> None:
    def learner(**more: str) -> Mapping[str, object]:
        graph, _ = launch_arguments.prepare("online_training", of("online_training", given) | more)
        return graph.node("learner").parameters

    starts = str(Path(given["model_dir"]) / "starts.safetensors")
    assert learner()["starts_file"] == starts and "video_model_dir" not in learner()
    video = learner(backend="video_model", video_model_dir=given["video_model_dir"])
    assert (video["starts_file"], video["video_model_dir"]) == (starts, given["video_model_dir"])
    assert "starts_file" not in learner(backend="environment")


def test_learner_of_several_ranks_is_not_composed(given: dict[str, str]) -> None:
    more = {"compose": "true", "learner_ranks": "2"}
    graph, _ = launch_arguments.prepare("online_training", of("online_training", given) | more)
    assert graph.node("learner").name == "learner"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"colour": "red"}, "unknown argument 'colour'"),
        ({"backend": "gazebo"}, "backend must be one of world_model, video_model, environment; got 'gazebo'"),
        ({"num_envs": "many"}, "num_envs must be a whole number, got 'many'"),
        ({"domain_id": "102"}, "domain_id must be 0 to 101, got 102"),
        ({"model_dir": "/nowhere"}, "holds no manifest.json"),
        ({"video_model_dir": "/trained"}, "video_model_dir would change nothing without backend:=video_model"),
        ({"view_port": "8080"}, "view_port would change nothing without view:=page"),
    ],
)
def test_bad_arguments_are_named(wrong: dict[str, str], message: str, given: dict[str, str]) -> None:
    with pytest.raises(GraphError, match=message):
        launch_arguments.prepare("rollout_record", of("rollout_record", given) | wrong)


def test_the_page_gets_a_free_port_shows_environment_0_and_is_not_required(given: dict[str, str]) -> None:
    asked = of("online_training", given) | {"view": "page"}
    graph, values = launch_arguments.prepare("online_training", asked)
    viewer = graph.node("viewer")
    assert not viewer.required and not viewer.lifecycle and all(node.required for node in graph.nodes[:-1])
    assert viewer.parameters["port"] == int(values["view_port"]) > 0
    assert [node.parameters["view_env"] for node in graph.nodes if node.name == "environment"] == [0, 0]
    assert Graph.from_json(graph.to_json()) == graph
    record = read_record(Path(values["run_dir"]))
    assert record is not None and not {"view", "view_port"} & set(record.options["online_training"])
    with LivePage() as other, pytest.raises(ValueError, match=f"port {other.port} of this host cannot be used"):
        launch_arguments.prepare("online_training", asked | {"view_port": str(other.port)})


def test_unknown_scenario_and_two_nodes_of_one_name_are_refused() -> None:
    with pytest.raises(GraphError, match="unknown scenario 'dance'"):
        parse_arguments("dance", {})
    with pytest.raises(GraphError, match="two nodes called wm/a"):
        Graph("g", (NodeSpec("m", "a"), NodeSpec("m", "a")))


def test_text_that_looks_like_a_number_stays_text_on_the_command_line() -> None:
    arguments = NodeSpec("m", "n", parameters={"a": "1", "b": 1, "c": True, "d": ["x"], "e": ""}).ros_arguments()
    assert arguments[-10:] == ["-p", 'a:="1"', "-p", "b:=1", "-p", "c:=true", "-p", 'd:=["x"]', "-p", 'e:=""']


def test_several_ranks_start_under_torchrun() -> None:
    program = NodeSpec("wm_nodes.nodes.learner_node", "learner", ranks=2).program()
    assert program[:3] == ["-m", "torch.distributed.run", "--standalone"]
    assert program[-3:] == ["--nproc-per-node=2", "-m", "wm_nodes.nodes.learner_node"]


def test_the_shipped_model_brings_the_first_frames_that_a_launch_file_imagines_from(tmp_path: Path) -> None:
    for task in ("push_cube", "reach"):
        _, values = launch_arguments.prepare("online_training", {"task": task, "run_dir": str(tmp_path / task)})
        images, states = load_starts(Path(values["starts_file"]))
        assert len(images) >= 32 and images.shape[1:] == (64, 128, 3) and states.shape == (len(images), 3)


def test_every_argument_is_used_and_described() -> None:
    used = {name for scenario in SCENARIOS.values() for name in scenario.arguments}
    assert used == {argument.name for argument in ARGUMENTS}
    assert all(argument.help and not argument.help.endswith(".") for argument in ARGUMENTS)
    assert all(argument.default in argument.choices for argument in ARGUMENTS if argument.choices)


def test_show_args_lists_every_argument(capsys: pytest.CaptureFixture[str]) -> None:
    assert main("evaluate", ["--show-args"]) == 0
    shown = capsys.readouterr().out
    assert shown.strip() == describe_arguments("evaluate") and "simulator_envs" in shown
    assert main("evaluate", ["seed=3"]) == 2


@dataclass
class Context:
    """launch.LaunchContext."""

    launch_configurations: dict[str, str]


class StubLaunch:
    """What generate_launch_description uses of ROS 2's launch and launch_ros: the one stub that the tests have."""

    def __init__(self, given: dict[str, str]) -> None:
        self.launch = types.ModuleType("launch")
        self.actions = types.ModuleType("launch.actions")
        self.substitutions = types.ModuleType("launch.substitutions")
        self.launch_ros = types.ModuleType("launch_ros")
        self.ros_actions = types.ModuleType("launch_ros.actions")

        class Record:
            def __init__(self, *arguments: Any, **named: Any) -> None:
                self.arguments, self.named = arguments, named

        class LaunchConfiguration(Record):
            def perform(self, context: Context) -> str:
                return context.launch_configurations[self.arguments[0]]

        self.launch.LaunchDescription = type("LaunchDescription", (Record,), {})
        for name in ("DeclareLaunchArgument", "OpaqueFunction", "Shutdown"):
            setattr(self.actions, name, type(name, (Record,), {}))
        self.substitutions.LaunchConfiguration = LaunchConfiguration
        self.ros_actions.Node = type("Node", (Record,), {})
        self.given = given

    def modules(self) -> dict[str, types.ModuleType]:
        return {
            "launch": self.launch, "launch.actions": self.actions, "launch.substitutions": self.substitutions,
            "launch_ros": self.launch_ros, "launch_ros.actions": self.ros_actions,
        }


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "compose"), FILES)
def test_both_faces_of_a_launch_file_start_the_same_processes(
    scenario: str, compose: dict[str, str], given: dict[str, str], repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setting = {} if "judge" in SCENARIOS[scenario].arguments else {"judge.max_reads": "3"}
    values = of(scenario, given) | compose | setting | ({"view_port": free_port("0")} if "view" in compose else {})
    stub = StubLaunch(values)
    for name, module in stub.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    path = repository / "launch_scripts" / f"{scenario}.launch.py"
    spec = importlib.util.spec_from_file_location("launch_file", path)
    assert spec is not None and spec.loader is not None
    file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(file)
    (entities,) = file.generate_launch_description().arguments
    note, *declared, start = entities
    defaults = {action.arguments[0]: action.named["default_value"] for action in declared}
    assert defaults == {argument.name: argument.default for argument in ARGUMENTS if argument.name in defaults}
    note.named["function"](Context(values))
    with holder(Path(values["run_dir"])), pytest.raises(RunFolderInUseError, match=r"is in use by process \d+ on"):
        start.named["function"](Context({**defaults, **values}))
    nodes = start.named["function"](Context({**defaults, **values}))
    record = read_record(Path(values["run_dir"]))
    assert record is not None and not {"run_dir", "domain_id", "respawn"} & set(record.options[scenario])
    assert not setting or record.settings["judge"]["max_reads"] == 3
    (lock,) = launch_face.LOCKS
    with pytest.raises(DomainInUseError, match=r"ROS domain 7 is already in use .*domain_id:=8"):
        start.named["function"](Context({**defaults, **values}))
    launch_face.LOCKS.clear()
    lock.release()

    runner = Runner(launch_arguments.prepare(scenario, values)[0], log=None, use_domain_lock=False)
    assert len(nodes) == len(runner.graph.nodes)
    for action, node in zip(nodes, runner.graph.nodes):
        assert action.named["executable"] == sys.executable
        assert action.named["arguments"] == node.program()
        assert action.named["namespace"] == node.namespace
        if node.inside:
            assert not {"name", "parameters"} & set(action.named)
            assert action.named["ros_arguments"][2:] == node.parameter_arguments()
        else:
            assert action.named["name"] == node.name
            assert action.named["parameters"] == ([dict(node.parameters)] if node.parameters else [])
        assert ("on_exit" in action.named) == (node.required and not node.respawn)
        assert action.named.get("respawn", False) == node.respawn == (values.get("respawn") == "true")
        assert action.named["additional_env"]["ROS_DOMAIN_ID"] == str(runner.domain) == "7"


def test_the_unrelated_launch_of_the_package_index_is_recognised(monkeypatch: pytest.MonkeyPatch) -> None:
    from wm_nodes.launching.launch_description import launch_description

    monkeypatch.setitem(sys.modules, "launch", types.ModuleType("launch"))
    with pytest.raises(ImportError, match=r"unrelated project.*online_training\.launch\.py"):
        launch_description("online_training")


def test_environment_of_nodes_stays_on_this_host_unless_told_otherwise() -> None:
    env = graph_environment(base={"PATH": "/usr/bin", "OMP_NUM_THREADS": "3"})
    assert env["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST" and env["ROS_DOMAIN_ID"] == "0"
    assert env["OMP_NUM_THREADS"] == "3" and env["FASTRTPS_DEFAULT_PROFILES_FILE"] == str(PROFILE)
    assert graph_environment(base={"ROS_DOMAIN_ID": "5"})["ROS_DOMAIN_ID"] == "5"
    assert graph_environment({"ROS_DOMAIN_ID": "9"}, base={"ROS_DOMAIN_ID": "5"})["ROS_DOMAIN_ID"] == "9"


def test_second_graph_on_a_domain_is_refused_with_the_first_ones_name(tmp_path: Path) -> None:
    with DomainLock(3, "graph 'one'", folder=tmp_path):
        with pytest.raises(DomainInUseError, match=r"ROS domain 3 .*graph 'one'.*ROS_DOMAIN_ID=4"):
            DomainLock(3, "graph 'two'", folder=tmp_path).acquire()
        DomainLock(4, "graph 'two'", folder=tmp_path).acquire()
    with DomainLock(3, "graph 'two'", folder=tmp_path):
        pass


def test_build_graph_passes_the_range_and_domain_on(given: dict[str, str]) -> None:
    graph, _ = launch_arguments.prepare("evaluate", of("evaluate", given) | {"discovery_range": "SUBNET"})
    assert graph.environment == {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_DOMAIN_ID": "7"}
