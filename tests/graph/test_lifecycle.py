"""Lifecycle transitions that fail, and what else real nodes answer without a graph; in this process."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from graph.toy import TwoCameras
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from unit.nodes.environment.test_lockstep import Bench, N

from wm_msgs.action import Replay
from wm_nodes.config.load import dump_config, load_config
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals
from wm_nodes.core.specs import SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.types import BoolArray, Observation, UInt64Array
from wm_nodes.nodes import environment_node
from wm_nodes.nodes.environment_node import EnvironmentNode
from wm_nodes.nodes.evaluation_node import EvaluationNode
from wm_nodes.nodes.player_node import PlayerNode
from wm_nodes.nodes.policy_node import PolicyNode
from wm_nodes.nodes.reward_evaluator_node import RewardEvaluatorNode
from wm_nodes.ros import convert
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.qos import topic
from wm_nodes.ros.spin import stop_on_signals

pytestmark = pytest.mark.graph
DONE, FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@pytest.fixture(autouse=True)
def context(domain: int) -> Iterator[None]:
    rclpy.init(domain_id=domain)
    yield
    rclpy.try_shutdown()


class Robot(TwoCameras):
    """Counts how often it was closed, and then raises `error`, where there is one; and how often it was told to hold.

    homing: called in each reset, as it begins.
    """

    def __init__(self, error: Exception | None = None, homing: Callable[[], object] = lambda: None) -> None:
        super().__init__(1, 0)
        self.spec = replace(self.spec, source=SOURCE_REAL)
        self.closed, self.held, self._error, self._homing = 0, 0, error, homing

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        self._homing()
        return super().reset(mask, seeds)

    def hold(self) -> None:
        assert not self.closed
        self.held += 1

    def close(self) -> None:
        self.closed += 1
        if self._error is not None:
            raise self._error


@pytest.fixture
def make_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    nodes = list[EnvironmentNode]()

    def make(robot: Robot, **parameters: Any) -> EnvironmentNode:
        monkeypatch.setattr(environment_node, "make_environment", lambda *_, **__: robot)
        (tmp_path / "config.yaml").write_text(dump_config(load_config("smoke")), encoding="utf-8")
        nodes.append(EnvironmentNode(parameter_overrides=[
            Parameter("config_file", value=str(tmp_path / "config.yaml")), Parameter("backend", value="environment"),
            *(Parameter(name, value=value) for name, value in parameters.items()),
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


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_a_robot_that_a_signal_stops_on_its_way_to_the_first_reset_holds_and_is_closed(make_node: Any) -> None:
    robot = Robot(homing=interrupt)
    node = make_node(robot, mode="asynchronous")
    with stop_on_signals() as stopped:
        assert not stopped.interrupt(node.start)
    assert (state(node), robot.held, robot.closed) == ("activating", 0, 0)
    node.stop()
    assert (robot.held, robot.closed) == (1, 1)


def test_a_robot_is_closed_where_a_signal_stops_the_configuration(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot()
    node = make_node(robot)
    monkeypatch.setattr(environment_node, "CameraTopics", lambda *_: interrupt())
    with stop_on_signals() as stopped:
        assert not stopped.interrupt(node.start)
    node.stop()
    assert (state(node), robot.held, robot.closed) == ("configuring", 0, 1)


def test_actions_that_would_always_be_too_old_are_refused_before_the_first_reset(make_node: Any) -> None:
    robot = Robot(homing=lambda: pytest.fail("it was reset"))
    node = make_node(robot, mode="asynchronous", control_period_s=0.5)
    assert not node.start() and state(node) == "inactive" and robot.held == 0
    assert "max_action_age_s 0.3 is not above the control period of 0.5 s" in condition(node)
    assert "raise max_action_age_s, or lower control_period_s" in condition(node)
    node.stop()


def test_a_robot_whose_first_reset_fails_holds_and_the_reason_stands(make_node: Any) -> None:
    def block() -> None:
        raise OSError("the way is blocked")

    robot = Robot(homing=block)
    node = make_node(robot, mode="asynchronous")
    assert not node.start() and (state(node), robot.held, robot.closed) == ("inactive", 1, 0)
    assert "the first reset failed" in condition(node) and "the way is blocked" in condition(node)
    node.stop()
    assert (state(node), robot.held, robot.closed) == ("finalized", 1, 1)


@pytest.mark.parametrize(
    ("make", "name"),
    [(PolicyNode, "step_timeout_s"), (EvaluationNode, "step_timeout_s"), (RewardEvaluatorNode, "summary_period_s")],
)
def test_a_parameter_that_only_configure_reads_cannot_be_set_while_the_node_runs(make: Any, name: str) -> None:
    node = make()
    refused = node.set_parameters_atomically([Parameter(name, value=2.5)])
    assert not refused.successful and f"start it again with {name}:=2.5" in refused.reason
    node.destroy_node()


def test_a_second_spec_of_one_session_is_refused_and_the_reward_evaluator_goes_on(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(dump_config(load_config("smoke")), encoding="utf-8")
    given = {"config_file": str(tmp_path / "config.yaml"), "reward": "rule", "image_wait_s": 60.0}
    node = RewardEvaluatorNode(parameter_overrides=[Parameter(name, value=value) for name, value in given.items()])
    assert node.trigger_configure() == DONE and node.trigger_activate() == DONE
    bench = Bench()
    bench.served.step(bench.command())
    spec, step = bench.served.spec, convert.transition_msg(bench.transitions[-1])
    step.session, step.episode_id = 1, convert.to_field(np.array([1, 2], np.uint64))

    def announce(session: int, spec: EnvironmentSpec, episode_id: int) -> None:
        """A spec, and a goal of its size for one episode."""
        message = convert.spec_msg(spec, 1)
        message.session = session
        node._on_spec(message)
        images, ids = np.zeros((N, spec.height, spec.width, 3), np.uint8), np.full(N, episode_id, np.uint64)
        goal = convert.goal_msg(Goals(1, images, np.ones(N, bool), ids, session), spec)
        goal.session = session
        with suppress(WireError):  # of another size than the spec in force
            node._on_goal(goal)

    larger = replace(spec, height=2 * spec.height)
    announce(1, spec, 1)
    announce(1, spec, 1)
    announce(1, larger, 2)
    node._on_transition(step)
    assert node._joiner._waiting
    node.set_parameters([Parameter("image_wait_s", value=0.0)])
    node._on_timer()
    assert not node._joiner._waiting
    assert node.diagnostics._counters["refused_specs"] == 1
    announce(2, larger, 2)
    assert node._spec == larger
    node.stop()
    node.destroy_node()


def test_a_node_that_calls_itself_failed_as_it_is_activated_has_not_started() -> None:
    class Node(ManagedNode):
        def activate(self) -> None:
            self.failed = True

    node = Node("node")
    assert not node.start() and node.failed and state(node) == "active"
    node.stop()
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
