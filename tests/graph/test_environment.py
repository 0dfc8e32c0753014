"""The environment node over DDS: lock-step rules, refusals, late joiners."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from graph.harness import Graph, Probe, wait_until
from graph.toy import ARM_STEPS
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from wm_msgs.action import Rollout
from wm_msgs.msg import EpisodeEvent, ErrorCode
from wm_msgs.srv import GetEnvSpec, ResetBatch, StepBatch
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.nodes.environment_node import HOLD_AFTER_S
from wm_nodes.recording.messages import images_of
from wm_nodes.ros import calls, convert
from wm_nodes.ros.wire import Reply, ResetCommand, StepCommand

pytestmark = pytest.mark.graph
N = 4


class Client:
    """A hand-driven client of env/step and env/reset."""

    def __init__(self, probe: Probe) -> None:
        self.probe = probe
        response = wait_until(
            "an active environment",
            lambda: (r := probe.call(GetEnvSpec, "env/get_spec", GetEnvSpec.Request())).error_code == 0 and r,
        )
        self.spec: EnvironmentSpec = convert.spec_from_msg(response.spec)
        self.session = response.spec.session

    def command(self, step_id: int, actions: Any = None, **changes: Any) -> StepCommand:
        actions = np.zeros((N, 3), np.float32) if actions is None else actions
        command = StepCommand(self.session, step_id, self.spec.spec_hash, np.asarray(actions, np.float32).reshape(-1))
        return replace(command, **changes)

    def step(self, command: StepCommand) -> Reply:
        response = self.probe.call(StepBatch, "env/step", calls.step_request(command))
        return calls.reply_of(response, self.spec, self.session)

    def reset(self, **arguments: Any) -> Reply:
        request = calls.reset_request(ResetCommand(**arguments))
        return calls.reply_of(self.probe.call(ResetBatch, "env/reset", request), self.spec)


@pytest.fixture
def client(graph: Graph, probe: Probe) -> Client:
    graph.start_environment(num_envs=N)
    return Client(probe)


@pytest.mark.slow
def test_a_step_moves_the_state_by_the_scaled_action_and_publishes_image_and_transition(client: Client) -> None:
    images, transitions = client.probe.listen("env/image"), client.probe.listen("env/transition")
    wait_until("matching", lambda: client.probe.node.count_publishers("/wm/env/transition"))
    before = client.reset(seeds=np.arange(N, dtype=np.uint64))
    wait_until("the reset's transition", lambda: transitions)
    actions = np.full((N, 3), 0.5, np.float32)
    after = client.step(client.command(before.step_id + 1, actions))
    np.testing.assert_allclose(after.states, before.states + 0.015, atol=1e-6)
    wait_until("the step's transition", lambda: len(transitions) == 2)
    wait_until("both images", lambda: len(images) == 2)
    step = convert.transition_of(transitions[1], client.spec)
    assert (step.stamp_ns, step.next_stamp_ns) == (before.stamp_ns, after.stamp_ns)
    np.testing.assert_array_equal(step.actions, actions)
    np.testing.assert_array_equal(images_of(images[1], client.spec), after.images)
    assert step.valid.all()
    assert convert.transition_of(transitions[0], client.spec).is_reset


def test_the_same_step_id_again_gives_the_stored_answer_and_does_not_step_twice(client: Client) -> None:
    start = client.reset()
    command = client.command(start.step_id + 1, np.full((N, 3), 0.2))
    first, second = client.step(command), client.step(command)
    np.testing.assert_array_equal(first.states, second.states)
    assert first.stamp_ns == second.stamp_ns


BAD_STEPS: list[tuple[dict[str, Any], int, str]] = [
    ({"step_id": 7}, ErrorCode.OUT_OF_ORDER, "continue with 1"),
    ({"spec_hash": "other"}, ErrorCode.SPEC_MISMATCH, "env/get_spec"),
    ({"session": 5}, ErrorCode.SPEC_MISMATCH, "restarted"),
    ({"actions": np.full(12, np.nan, np.float32)}, ErrorCode.NAN_INPUT, "environments [0, 1, 2, 3]"),
    ({"actions": np.full(12, 1.5, np.float32)}, ErrorCode.OUT_OF_RANGE, "1.5"),
    ({"actions": np.zeros(11, np.float32)}, ErrorCode.BAD_SHAPE, "11 values"),
    ({"logprobs": np.zeros(3, np.float32)}, ErrorCode.BAD_SHAPE, "log_prob has 3"),
]


def test_a_bad_step_is_refused_with_value_and_remedy_and_changes_nothing(client: Client) -> None:
    start = client.reset()
    for changes, code, words in BAD_STEPS:
        with pytest.raises(WireError) as refused:
            client.step(replace(client.command(start.step_id + 1), **changes))
        assert refused.value.code == code, changes
        assert words in str(refused.value), changes
    good = client.step(client.command(start.step_id + 1))
    np.testing.assert_array_equal(good.states, start.states)
    count = str(len(BAD_STEPS))
    wait_until("the count in diagnostics", lambda: client.probe.value("/wm/environment", "refused_step") == count)


def test_a_step_before_any_reset_and_a_foreign_task_are_refused(client: Client) -> None:
    with pytest.raises(WireError, match="call env/reset first"):
        client.step(client.command(1))
    with pytest.raises(WireError, match="'stack' is not served") as refused:
        client.reset(task="stack")
    assert refused.value.code == ErrorCode.NOT_FOUND


def test_estop_ends_the_episodes_and_refuses_steps_until_it_is_released(client: Client) -> None:
    events = client.probe.listen("episode")
    estop = client.probe.publisher("safety/estop")
    wait_until("matching", lambda: estop.get_subscription_count())
    start = client.reset()
    estop.publish(Bool(data=True))
    wait_until("ended episodes", lambda: sum(e.termination_reason == EpisodeEvent.REASON_ESTOP for e in events) == N)
    with pytest.raises(WireError, match="emergency stop"):
        client.step(client.command(start.step_id + 1))
    estop.publish(Bool(data=False))
    wait_until("release", lambda: _stepped(client, start.step_id + 1))


def test_a_robot_is_told_to_hold_by_an_emergency_stop_between_two_requests(graph: Graph, probe: Probe) -> None:
    estop = probe.publisher("safety/estop")
    graph.start_environment("toy:make_robot", num_envs=1)
    client = Client(probe)
    wait_until("matching", estop.get_subscription_count)
    start = client.reset()
    client.step(client.command(start.step_id + 1, np.full((1, 3), 0.5)))
    estop.publish(Bool(data=True))
    wait_until("the hold", lambda: "\ntold 0\n" in graph.log("/wm/environment"))
    with pytest.raises(WireError, match="emergency stop"):
        client.step(client.command(start.step_id + 2, np.zeros((1, 3))))
    assert graph.log("/wm/environment").count("told 0\n") == 1


def told(graph: Graph) -> list[str]:
    """What a toy's robot was told to do."""
    return [line for line in graph.log("/wm/environment").splitlines() if line.startswith("told")]


ARMS = [("toy:make_velocity_arm", "told 0"), ("toy:make_holding_arm", "told to hold")]


@pytest.mark.parametrize(("factory", "hold"), ARMS)
def test_a_robot_holds_when_its_episode_ends_and_again_by_an_emergency_stop_after_that(
    graph: Graph, probe: Probe, factory: str, hold: str
) -> None:
    estop = probe.publisher("safety/estop")
    graph.start_environment(factory, num_envs=1)
    client = Client(probe)
    wait_until("matching", estop.get_subscription_count)
    first = client.reset().step_id + 1
    replies = [client.step(client.command(first + i, np.full((1, 3), 0.75))) for i in range(ARM_STEPS)]
    assert replies[-1].truncated.all()
    assert told(graph) == ["told 0.75"] * ARM_STEPS + [hold]
    estop.publish(Bool(data=True))
    wait_until("the second hold", lambda: told(graph)[ARM_STEPS:] == [hold, hold])


@pytest.mark.parametrize(("factory", "hold"), ARMS)
def test_a_robot_holds_when_a_rollout_leaves_it_within_an_episode(
    graph: Graph, probe: Probe, factory: str, hold: str
) -> None:
    graph.start_environment(factory, num_envs=1)
    graph.start_policy()
    result = probe.finish(probe.send(probe.action(Rollout, "rollout"), Rollout.Goal(steps=2, reset=True)))
    assert result.termination_reason == Rollout.Result.FINISHED, result.message
    wait_until("the hold", lambda: len(told(graph)) == 3)
    assert told(graph)[2] == hold and hold not in told(graph)[:2]


@pytest.mark.kills
def test_a_robot_holds_once_when_its_client_dies_within_an_episode(graph: Graph, probe: Probe) -> None:
    graph.start_environment("toy:make_robot", num_envs=1)
    graph.start_policy()
    probe.send(probe.action(Rollout, "rollout"), Rollout.Goal(steps=100_000, reset=True))
    wait_until("motion", lambda: len(told(graph)) > 5)
    graph.kill("/wm/policy")
    wait_until("the hold", lambda: told(graph)[-1] == "told 0")
    made = len(told(graph))
    wait_until("the count", lambda: probe.value("/wm/environment", "idle_holds") == "1")
    time.sleep(2 * HOLD_AFTER_S)
    assert len(told(graph)) == made and "no step came for 1 s within an episode" in graph.log("/wm/environment")


def test_a_rollout_ends_where_somebody_else_resets_and_one_after_a_cancelled_one_begins_with_a_reset(
    graph: Graph, probe: Probe
) -> None:
    transitions, endless = probe.listen("env/transition"), Rollout.Goal(steps=100_000, reset=True)
    graph.start_environment("toy:make_long_environment", num_envs=N)
    graph.start_policy()
    client, rollout = Client(probe), probe.action(Rollout, "rollout")

    def begin() -> Any:
        seen, handle = len(transitions), probe.send(rollout, endless)
        wait_until("steps", lambda: len(transitions) > seen + 5)
        return handle

    handle = begin()
    client.reset()
    result = probe.finish(handle)
    assert result.termination_reason == Rollout.Result.PEER_LOST
    assert "another client has reset environments [0, 1, 2, 3] within the episode" in result.message
    assert probe.cancel(begin()).termination_reason == Rollout.Result.CANCELED
    newest = transitions[-1].episode_id[0]
    result = probe.finish(probe.send(rollout, Rollout.Goal(steps=3)))
    assert result.termination_reason == Rollout.Result.FINISHED, result.message
    wait_until("episodes of its own", lambda: transitions[-1].episode_id[0] > newest)


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
def test_an_emergency_stop_is_heard_from_a_publisher_that_latches_nothing(
    graph: Graph, probe: Probe, reliability: ReliabilityPolicy
) -> None:
    estop = probe.node.create_publisher(Bool, "safety/estop", QoSProfile(depth=10, reliability=reliability))
    graph.start_environment(num_envs=N)
    graph.start_policy()
    client, nodes = Client(probe), ("/wm/environment", "/wm/policy")
    start = client.reset()
    wait_until("both nodes", lambda: all(node in probe.diagnostics for node in nodes))
    wait_until("matching", lambda: estop.get_subscription_count() >= len(nodes))
    estop.publish(Bool(data=True))
    for node in nodes:
        wait_until("the condition", lambda: "emergency stop is set" in probe.diagnostics[node].message)  # noqa: B023
    with pytest.raises(WireError, match="emergency stop"):
        client.step(client.command(start.step_id + 1))
    estop.publish(Bool(data=False))
    wait_until("release", lambda: _stepped(client, start.step_id + 1))


def _stepped(client: Client, step_id: int) -> bool:
    try:
        client.step(client.command(step_id))
    except WireError as error:
        if error.code != ErrorCode.ESTOP:
            raise
        return False
    return True


def test_a_masked_environment_is_reset_instead_of_stepped(client: Client) -> None:
    start = client.reset(seeds=np.arange(N, dtype=np.uint64))
    transitions = client.probe.listen("env/transition")
    wait_until("matching", lambda: client.probe.node.count_publishers("/wm/env/transition"))
    mask = np.array([True, False, False, False])
    seeds = np.full(N, 3, np.uint64)
    after = client.step(client.command(start.step_id + 1, np.full((N, 3), 1.0), reset_mask=mask, reset_seeds=seeds))
    np.testing.assert_array_equal(after.states[0], start.states[3])
    assert after.episode_ids[0] != start.episode_ids[0]
    step = convert.transition_of(wait_until("the transition", lambda: transitions)[-1], client.spec)
    assert step.valid.tolist() == [False, True, True, True]
    assert step.episode_ids[0] == start.episode_ids[0]


def test_a_late_joiner_gets_the_latched_spec_and_goal(client: Client) -> None:
    client.reset()
    specs, goals = client.probe.listen("env/spec"), client.probe.listen("env/goal")
    assert convert.spec_from_msg(wait_until("the spec", lambda: specs)[0]) == client.spec
    wait_until("the goal message", lambda: goals)


def test_a_stopped_environment_ends_its_episodes_as_deactivated(client: Client, graph: Graph) -> None:
    events = client.probe.listen("episode")
    wait_until("an event: the probe sees a publisher before that sees it", lambda: (client.reset(), events)[1])
    assert graph.stop() == {"/wm/environment": 0}
    wait_until(
        "ends", lambda: sum(e.termination_reason == EpisodeEvent.REASON_DEACTIVATED for e in events) == N, timeout_s=5
    )
