"""Lifecycle transitions that fail, and what else real nodes answer without a graph; in this process."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import rclpy
from graph.toy import TwoCameras
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter

from wm_msgs.action import Replay
from wm_nodes.config.load import dump_config, load_config
from wm_nodes.nodes import environment_node
from wm_nodes.nodes.environment_node import EnvironmentNode
from wm_nodes.nodes.evaluation_node import EvaluationNode
from wm_nodes.nodes.player_node import PlayerNode
from wm_nodes.nodes.policy_node import PolicyNode
from wm_nodes.nodes.reward_evaluator_node import RewardEvaluatorNode
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.qos import topic

pytestmark = pytest.mark.graph
DONE, FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@pytest.fixture(autouse=True)
def context(domain: int) -> Iterator[None]:
    rclpy.init(domain_id=domain)
    yield
    rclpy.try_shutdown()


class Robot(TwoCameras):
    """Counts how often it was closed, and then raises `error`, where there is one."""

    def __init__(self, error: Exception | None = None) -> None:
        super().__init__(1, 0)
        self.closed, self._error = 0, error

    def close(self) -> None:
        self.closed += 1
        if self._error is not None:
            raise self._error


@pytest.fixture
def make_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    nodes = list[EnvironmentNode]()

    def make(robot: Robot) -> EnvironmentNode:
        monkeypatch.setattr(environment_node, "make_environment", lambda *_, **__: robot)
        (tmp_path / "config.yaml").write_text(dump_config(load_config("smoke")), encoding="utf-8")
        nodes.append(EnvironmentNode(parameter_overrides=[
            Parameter("config_file", value=str(tmp_path / "config.yaml")), Parameter("backend", value="environment")
        ]))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


def state(node: ManagedNode) -> str:
    return str(node._state_machine.current_state[1])


def condition(node: ManagedNode) -> str:
    return node.diagnostics._summary()[1]


def test_a_robot_whose_node_cannot_be_configured_is_closed_once_and_the_reason_stands(make_node: Any) -> None:
    robot = Robot()
    robot.cameras = tuple(replace(camera, name=f"{camera.name}_2") for camera in robot.cameras)
    node = make_node(robot)
    assert (node.trigger_configure(), state(node), robot.closed) == (FAILED, "unconfigured", 1)
    assert "camera 'top_2' is none of ['top', 'hand']" in condition(node)
    node._on_diagnostics()
    node.stop()
    assert robot.closed == 1


def test_a_robot_that_cannot_be_closed_after_a_failed_configuration_hides_no_reason(make_node: Any) -> None:
    robot = Robot(RuntimeError("no answer"))
    robot.cameras = tuple(replace(camera, name=f"{camera.name}_2") for camera in robot.cameras)
    node = make_node(robot)
    assert (node.trigger_configure(), state(node), robot.closed) == (FAILED, "unconfigured", 1)
    assert "camera 'top_2' is none of ['top', 'hand']" in condition(node)


@pytest.mark.parametrize("error", [OSError("no answer"), RuntimeError("no answer")])
def test_a_node_whose_robot_cannot_be_closed_is_unconfigured_and_can_be_configured_again(
    make_node: Any, error: Exception
) -> None:
    robot = Robot(error)
    node = make_node(robot)
    assert node.trigger_configure() == DONE
    node.trigger_cleanup()
    assert (state(node), robot.closed) == ("unconfigured", 1)
    assert node.trigger_configure() == DONE and state(node) == "inactive"
    assert node.count_subscribers(topic("safety/estop").name) == 2


@pytest.mark.parametrize(
    ("make", "name"),
    [(PolicyNode, "step_timeout_s"), (EvaluationNode, "step_timeout_s"), (RewardEvaluatorNode, "summary_period_s")],
)
def test_a_parameter_that_only_configure_reads_cannot_be_set_while_the_node_runs(make: Any, name: str) -> None:
    node = make()
    refused = node.set_parameters_atomically([Parameter(name, value=2.5)])
    assert not refused.successful and f"start it again with {name}:=2.5" in refused.reason
    node.destroy_node()


def test_a_bag_that_cannot_be_played_on_for_whatever_reason_is_an_error_of_the_player(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    node = PlayerNode()

    def fail(*_: Any) -> None:
        raise RuntimeError("publisher is gone")

    monkeypatch.setattr(node, "_play", fail)
    node._play_alone(None, Replay.Goal())  # type: ignore[arg-type]
    assert condition(node) == "publisher is gone"
    node.destroy_node()
