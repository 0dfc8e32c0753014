"""Answers that are lost or late, on a real wire."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from deadlines import PATIENCE_S
from graph.harness import Graph, Probe, wait_until
from graph.toy import HOMING_S
from rclpy.action import ActionServer, CancelResponse

from benchmarks.speed.graph import remote_environments
from wm_msgs.action import Train
from wm_msgs.msg import EpisodeEvent
from wm_msgs.srv import GetEnvSpec
from wm_nodes.launching.graph_client import GraphClient
from wm_nodes.ros.goals import goal_result
from wm_nodes.ros.wire import PeerLost

pytestmark = pytest.mark.graph


class LossyServer(ActionServer):
    """Answers no request for a result until `lost` of them have come, as where the client's reader is not matched."""

    def __init__(self, node: Any, lost: int) -> None:
        super().__init__(node, Train, "train", self._train)
        self.lost, self.asked = lost, 0

    def forget(self) -> None:
        """Know no goal, as after a restart."""
        self._goal_handles.clear()

    async def _execute_get_result_request(self, request_header_and_message: Any) -> None:
        self.asked += 1
        if self.asked > self.lost:
            await super()._execute_get_result_request(request_header_and_message)

    def _train(self, goal: Any) -> Train.Result:
        goal.succeed()
        return Train.Result(termination_reason=Train.Result.FINISHED, updates=goal.request.updates)


@pytest.fixture
def other(domain: int) -> Iterator[Probe]:
    """Has the server; in a context and an executor of its own."""
    probe = Probe(domain)
    yield probe
    probe.close()


@pytest.mark.slow
def test_a_lost_result_of_a_goal_is_asked_for_again(probe: Probe, other: Probe) -> None:
    server = LossyServer(other.node, lost=2)
    handle = probe.send(probe.action(Train, "train"), Train.Goal(updates=5))
    result = goal_result(handle, 30.0, lambda: None)
    assert (result.termination_reason, result.updates) == (Train.Result.FINISHED, 5)
    assert server.asked == 3
    server.destroy()


def test_a_result_is_asked_for_once_where_it_arrives(probe: Probe, other: Probe) -> None:
    server = LossyServer(other.node, lost=0)
    assert goal_result(probe.send(probe.action(Train, "train"), Train.Goal(updates=5)), 30.0, lambda: None).updates == 5
    assert server.asked == 1
    server.destroy()


def test_a_server_that_has_forgotten_the_goal_gives_an_error_and_not_an_empty_result(
    probe: Probe, other: Probe
) -> None:
    server = LossyServer(other.node, lost=1)
    handle = probe.send(probe.action(Train, "train"), Train.Goal(updates=5))
    wait_until("the end of the goal", lambda: handle.status == GoalStatus.STATUS_SUCCEEDED)
    server.forget()
    with pytest.raises(PeerLost, match="train does not know the goal it accepted; was its node restarted"):
        goal_result(handle, 30.0, lambda: None)
    server.destroy()


class TellingServer(ActionServer):
    """Tells feedback until its goal is cancelled."""

    def __init__(self, node: Any) -> None:
        super().__init__(
            node, Train, "train", lambda goal: Train.Result(), handle_accepted_callback=self._begin,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )
        self.canceled = threading.Event()

    def _begin(self, goal: Any) -> None:
        threading.Thread(target=self._tell, args=(goal,)).start()

    def _tell(self, goal: Any) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not goal.is_cancel_requested and time.monotonic() < deadline:
            goal.publish_feedback(Train.Feedback(update=1))
            time.sleep(0.02)
        if goal.is_cancel_requested:
            self.canceled.set()
        goal.execute()


def test_what_a_callback_of_feedback_raises_ends_the_goal_and_reaches_the_caller(
    domain: int, other: Probe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    server = TellingServer(other.node)
    told = list[Any]()

    def show(feedback: Any) -> None:
        told.append(feedback)
        raise BrokenPipeError("nobody reads")

    with GraphClient() as client, pytest.raises(BrokenPipeError, match="nobody reads"):
        client.train(5, show)
    assert server.canceled.wait(PATIENCE_S) and len(told) == 1
    server.destroy()


@pytest.mark.slow
def test_a_reset_longer_than_half_its_deadline_is_made_once_and_answered(
    graph: Graph, probe: Probe, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = probe.listen("episode")
    graph.start_environment("toy:make_homing_environment", num_envs=2)
    asked = GetEnvSpec.Request()
    wait_until("an environment", lambda: probe.call(GetEnvSpec, "env/get_spec", asked).error_code == 0)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))
    with remote_environments("caller", graph.folder, ("",), lambda: None, timeout_s=1.6 * HOMING_S) as (environment,):
        for seed in (7, 7):
            reset = environment.reset(seeds=np.full(2, seed, np.uint64))
            stepped = environment.step(np.zeros((2, 3), np.float32))
            assert stepped.observation.episode_id.tolist() == reset.episode_id.tolist() and stepped.valid.all()
    wait_until("the last episodes", lambda: {3, 4} <= {event.episode_id for event in events if started(event)})
    assert [event.episode_id for event in events if started(event)] == [1, 2, 3, 4]


def started(event: EpisodeEvent) -> bool:
    return bool(event.kind == EpisodeEvent.KIND_START)
