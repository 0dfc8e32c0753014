"""What `ros2 launch` imports under the system's Python, and the arguments that plug things in."""

import subprocess
import sys
from pathlib import Path

import pytest

from wm_nodes.config.load import load_config
from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching.graph import Graph, GraphError
from wm_nodes.launching.launch_description import prepare_graph
from wm_nodes.launching.scenarios import GRAPH_TOPICS
from wm_nodes.recording import topics

BLOCKED = "pydantic", "yaml", "numpy", "torch", "rclpy", "wm_msgs", "rosbags", "mcap"
IMPORT = """
import sys

class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Block())
sys.path.insert(0, {package!r})
from wm_nodes.launching import launch_description
print(len(launch_description.argument_table("online_training")))
"""


@pytest.fixture
def given(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "manifest.json").write_text("{}")
    return {"run_dir": str(tmp_path / "run"), "model_dir": str(tmp_path), "preset": "smoke", "domain_id": "7"}


def test_the_launch_face_needs_nothing_but_the_standard_library(repository: Path) -> None:
    code = IMPORT.format(blocked=BLOCKED, package=str(repository / "wm_nodes"))
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20


@pytest.mark.parametrize("compose", ["false", "true"])
def test_the_graph_that_the_nodes_interpreter_makes_is_the_same(compose: str, given: dict[str, str]) -> None:
    given = {**given, "compose": compose}
    graph, _ = launch_arguments.prepare("online_training", given)
    assert prepare_graph("online_training", given, sys.executable) == graph
    assert Graph.from_json(graph.to_json()) == graph


def test_a_wrong_argument_reaches_the_user_of_ros2_launch_as_one_line(given: dict[str, str]) -> None:
    with pytest.raises(RuntimeError, match=r"^num_envs must be a whole number, got 'many'$"):
        prepare_graph("online_training", {**given, "num_envs": "many"}, sys.executable)
    with pytest.raises(RuntimeError, match="set WM_PYTHON"):
        prepare_graph("online_training", given, "/bin/false")


def test_both_recording_scenarios_record_the_episodes_of_the_simulator(given: dict[str, str]) -> None:
    assert tuple(GRAPH_TOPICS) and set(GRAPH_TOPICS) == {topic.name for topic in topics.ALL_TOPICS}
    for scenario in ("online_training", "evaluate"):
        graph, _ = launch_arguments.prepare(scenario, given)
        recorded = graph.node("recorder").parameters["topics"]
        assert isinstance(recorded, list)
        assert {"sim/env/spec", "sim/env/image", "sim/env/transition", "sim/env/goal", "sim/episode"} <= set(recorded)
    graph, _ = launch_arguments.prepare("online_training", {**given, "simulator": "false"})
    assert graph.node("recorder").parameters["topics"] == list(GRAPH_TOPICS)


def test_a_video_model_is_stepped_where_it_is_named_as_the_backend(given: dict[str, str], tmp_path: Path) -> None:
    chosen = {**given, "backend": "video_model", "video_model_dir": str(tmp_path)}
    for scenario in ("online_training", "rollout_record"):
        graph, values = launch_arguments.prepare(scenario, chosen)
        parameters = graph.node("wm/environment").parameters
        assert (parameters["backend"], parameters["video_model_dir"]) == ("video_model", str(tmp_path))
        assert parameters["starts_file"] == values["starts_file"] and "model_dir" not in parameters
        assert graph.node("reward_evaluator").parameters["reward"] == "endogenous"
        with pytest.raises(GraphError, match="backend:=video_model needs video_model_dir:=<folder"):
            launch_arguments.prepare(scenario, {**chosen, "video_model_dir": ""})


def test_every_node_of_every_way_to_start_has_the_limit_of_its_memory(given: dict[str, str]) -> None:
    for more, limit in (({}, -1.0), ({"memory_limit_gib": "2.5"}, 2.5), ({"memory_limit_gib": "0"}, 0.0)):
        for compose in ("false", "true"):
            graph, _ = launch_arguments.prepare("online_training", {**given, **more, "compose": compose})
            nodes = [node for process in graph.nodes for node in process.carried()]
            assert {node.parameters["memory_limit_gib"] for node in nodes} == {limit}
    with pytest.raises(GraphError, match="memory_limit_gib must be a number, got 'much'"):
        launch_arguments.prepare("evaluate", {**given, "memory_limit_gib": "much"})


def test_plug_ins_and_a_parameter_file_reach_the_nodes(given: dict[str, str], tmp_path: Path) -> None:
    file = tmp_path / "more.yaml"
    file.write_text("/**:\n  ros__parameters:\n    peer_timeout_s: 9.0\n")
    more = {"backend": "environment", "params_file": str(file), "environment.factory": "robot:make",
            "policy.factory": "mine:policy", "reward.factory": "mine:reward"}
    graph, values = launch_arguments.prepare("rollout_record", {**given, **more})
    assert graph.node("environment").parameters["backend"] == "environment"
    config = load_config(f"{values['run_dir']}/config.yaml")
    factories = config.environment.factory, config.policy.factory, config.reward.factory
    assert factories == ("robot:make", "mine:policy", "mine:reward")
    assert all(node.ros_arguments()[-2:] == ["--params-file", str(file)] for node in graph.nodes)
    graph, _ = launch_arguments.prepare("evaluate", {**given, "initial_policy": "/weights.safetensors"})
    assert graph.node("evaluation").parameters["initial_policy"] == "/weights.safetensors"


def test_without_a_task_the_model_is_named_and_nothing_is_measured_where_evaluation_is_none(
    given: dict[str, str]
) -> None:
    more = {"task": "", "model_dir": "", "evaluation.environment": "none", "run_dir": f"{given['run_dir']}_own"}
    with pytest.raises(GraphError, match="no world model is shipped for task ''"):
        launch_arguments.prepare("online_training", {**given, **more})
    graph, _ = launch_arguments.prepare("online_training", {**given, **more, "model_dir": given["model_dir"]})
    assert "evaluation" not in {node.name for node in graph.nodes}
    graph, _ = launch_arguments.prepare("rollout_record", {**given, **more, "backend": "environment"})
    assert graph.node("policy").parameters["model_dir"] == ""


def test_a_parameter_file_that_is_missing_is_refused(given: dict[str, str]) -> None:
    with pytest.raises(GraphError, match=r"params_file '/no\.yaml' does not exist"):
        launch_arguments.prepare("rollout_record", {**given, "params_file": "/no.yaml"})
