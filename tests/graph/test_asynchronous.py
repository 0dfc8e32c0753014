"""The environment on its own clock, and the policy that acts on what it sees, over DDS."""

import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from graph import toy
from graph.harness import Graph, Probe, wait_until
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import Image
from std_msgs.msg import Bool

from wm_msgs.action import Rollout
from wm_msgs.msg import ActionBatch, Credit, EpisodeEvent, ErrorCode
from wm_msgs.srv import StepBatch
from wm_nodes.recording.messages import time_ns
from wm_nodes.ros import calls, convert
from wm_nodes.ros.qos import topic
from wm_nodes.ros.wire import StepCommand

pytestmark = [pytest.mark.graph, pytest.mark.alone]
N = 2


def value(probe: Probe, key: str, node: str = "/wm/environment") -> int:
    return int(probe.value(node, key) or 0)


def held(transition: Any) -> bool:
    return not any(transition.action)


def test_the_environment_keeps_its_own_time_holds_without_actions_and_counts_it(graph: Graph, probe: Probe) -> None:
    transitions, events = probe.listen("env/transition"), probe.listen("episode")
    graph.start_environment(num_envs=N, mode="asynchronous", control_period_s=0.05)
    wait_until("steps without any request", lambda: len(transitions) > 20)
    assert all(held(message) and not any(message.policy_version) for message in transitions)
    assert all(message.state == message.next_state for message in transitions if all(message.valid))
    assert {after.step_id - before.step_id for before, after in pairwise(list(transitions))} == {1}
    wait_until("the count of held steps", lambda: value(probe, "action_timeouts") > 10)
    wait_until("ended and restarted episodes", lambda: len({event.episode_id for event in events}) > N)
    command = StepCommand(0, 1, "", np.zeros(3 * N, np.float32))
    refused = probe.call(StepBatch, "env/step", calls.step_request(command))
    assert refused.error_code == ErrorCode.OUT_OF_ORDER
    assert "mode:=lockstep" in refused.message


def test_a_fresh_action_moves_a_stale_or_bad_one_does_not(graph: Graph, probe: Probe) -> None:
    transitions = probe.listen("env/transition")
    actions = probe.publisher("action")
    graph.start_environment(num_envs=N, mode="asynchronous", control_period_s=0.1, max_action_age_s=1.0)
    wait_until("the environment", lambda: len(transitions) > 2 and actions.get_subscription_count())

    def send(fill: float, stamp: Any, **changes: Any) -> None:
        message = ActionBatch(num_envs=N, action_dim=3, chunk_length=1, policy_version=4, **changes)
        message.header.stamp = stamp
        message.action = convert.to_field(np.full(3 * N, fill, np.float32))
        actions.publish(message)

    send(0.25, transitions[-1].next_stamp)
    moved = wait_until("a step with the action", lambda: [t for t in transitions if not held(t) and all(t.valid)])[0]
    assert set(moved.action) == {0.25}
    assert set(moved.policy_version) == {4}
    np.testing.assert_allclose(np.subtract(moved.next_state, moved.state), 0.25 * 0.03, atol=1e-6)
    wait_until("to hold when the action is old", lambda: held(transitions[-1]))
    moves = sum(not held(t) for t in transitions)
    send(0.5, transitions[0].header.stamp)
    wait_until("the stale one's count", lambda: value(probe, "refused_action") == 1)
    send(np.nan, transitions[-1].next_stamp)
    wait_until("the bad one's count", lambda: value(probe, "refused_action") == 2)
    send(0.5, transitions[-1].next_stamp, mode=ActionBatch.MODE_HOLD)
    seen = len(transitions)
    wait_until("further steps", lambda: len(transitions) > seen + 3)
    assert sum(not held(t) for t in transitions) == moves


def test_the_policy_acts_on_images_in_real_time_and_says_hold_when_it_stops(graph: Graph, probe: Probe) -> None:
    transitions, actions = probe.listen("env/transition"), probe.listen("action")
    graph.start_environment(num_envs=N, mode="asynchronous", control_period_s=0.1, max_action_age_s=2.0)
    policy = graph.start_policy(mode="asynchronous")
    wait_until("actions", lambda: len(actions) > 10)
    wait_until("steps with them", lambda: sum(not held(t) for t in transitions) > 10)
    stamps = {time_ns(t.next_stamp) for t in transitions}
    assert sum(time_ns(a.header.stamp) in stamps for a in actions) > 5
    moved = next(t for t in reversed(transitions) if not held(t))
    assert any(np.array_equal(moved.action, a.action) for a in actions)
    client = probe.action(Rollout, "rollout")
    refused = probe.finish(probe.send(client, Rollout.Goal(steps=3)))
    assert refused.termination_reason == Rollout.Result.FAILED
    assert "mode:=lockstep" in refused.message
    policy.terminate()
    assert policy.wait(20) == 0
    wait_until("the hold", lambda: actions[-1].mode == ActionBatch.MODE_HOLD)
    wait_until("a held step", lambda: held(transitions[-1]))


def test_stamps_are_wall_time_that_passes_as_the_environment_steps(graph: Graph, probe: Probe) -> None:
    period_s, delays_s = 0.05, list[float]()
    row, clock = topic("env/image"), probe.node.get_clock()

    def note(image: Image) -> None:
        delays_s.append((clock.now().nanoseconds - time_ns(image.header.stamp)) / 1e9)

    probe.node.create_subscription(row.type, row.name, note, row.qos)
    transitions = probe.listen("env/transition")
    graph.start_environment(num_envs=N, mode="asynchronous", control_period_s=period_s)
    wait_until("steps", lambda: len(transitions) > 40)
    steps = [t for t in transitions if t.header.stamp != t.next_stamp]
    took_s = [(time_ns(t.next_stamp) - time_ns(t.header.stamp)) / 1e9 for t in steps]
    assert min(took_s) > 0
    assert np.median(took_s) == pytest.approx(period_s, rel=0.2)
    assert 0 < min(delays_s) <= np.median(delays_s) < period_s


PERIOD_S = 0.5


def test_no_action_is_published_or_executed_after_an_emergency_stop_until_it_is_released(
    graph: Graph, probe: Probe
) -> None:
    """The policy computes most of the time, so the stop comes while an inference is running."""
    transitions, actions, arrived_s = probe.listen("env/transition"), probe.listen("action"), list[float]()
    row = topic("action")
    probe.node.create_subscription(row.type, row.name, lambda _: arrived_s.append(time.monotonic()), row.qos)
    estop = probe.publisher("safety/estop")
    graph.start_environment(
        "toy:make_long_environment", num_envs=N, mode="asynchronous", control_period_s=PERIOD_S, max_action_age_s=5.0
    )
    policy = graph.start("policy", policy__factory="toy:make_slow_policy", mode="asynchronous")
    wait_until("both readers of both nodes", lambda: estop.get_subscription_count() >= 4)
    for _ in range(3):
        seen = len(actions)
        wait_until("actions", lambda: len(actions) > seen + 2 and not held(transitions[-1]))  # noqa: B023
        count = len(transitions)
        wait_until("the next observation", lambda: len(transitions) > count)  # noqa: B023
        time.sleep(toy.SLOW_S / 2)  # into the inference
        estop.publish(Bool(data=True))
        stopped_s = time.monotonic()
        wait_until("the hold", lambda: actions[-1].mode == ActionBatch.MODE_HOLD)
        time.sleep(PERIOD_S)
        count, made = len(actions), len(transitions)
        for node in ("/wm/environment", "/wm/policy"):
            wait_until("the condition", lambda: "emergency stop is set" in probe.diagnostics[node].message)  # noqa: B023
            assert probe.diagnostics[node].level == DiagnosticStatus.ERROR
            assert "publish false on safety/estop to go on" in probe.diagnostics[node].message
        time.sleep(2 * PERIOD_S)
        assert (len(actions), len(transitions)) == (count, made)
        assert max(arrived_s) < stopped_s + PERIOD_S and actions[-1].mode == ActionBatch.MODE_HOLD
        assert sum(message.mode == ActionBatch.MODE_HOLD for message in actions[seen:]) == 1
        estop.publish(Bool(data=False))
        wait_until("steps again", lambda: len(transitions) > made + 1)  # noqa: B023
        assert held(transitions[made]), "no action from before the stop is carried out after it"
    wait_until("no condition", lambda: probe.diagnostics["/wm/policy"].level == DiagnosticStatus.OK)
    estop.publish(Bool(data=True))
    policy.terminate()
    assert policy.wait(20) == 0
    del probe.diagnostics["/wm/policy"]
    count = len(actions)
    graph.start("policy", policy__factory="toy:make_slow_policy", mode="asynchronous")
    wait_until("the new policy", lambda: "/wm/policy" in probe.diagnostics)
    wait_until("the stop in it", lambda: "emergency stop" in probe.diagnostics["/wm/policy"].message)
    send = probe.publisher("action")
    wait_until("matching", send.get_subscription_count)
    message = ActionBatch(num_envs=N, action_dim=3, chunk_length=1)
    message.action = convert.to_field(np.full(3 * N, 0.5, np.float32))
    made = len(transitions)
    send.publish(message)  # of somebody who does not obey
    wait_until("the refusal", lambda: value(probe, "refused_action"))
    assert all(m.mode == ActionBatch.MODE_HOLD for m in actions[count:] if m.session) and len(transitions) == made
    estop.publish(Bool(data=False))
    wait_until("actions of the new policy", lambda: len(actions) > count + 3)


def test_a_robot_holds_while_nobody_takes_its_steps_and_when_its_node_is_deactivated(
    graph: Graph, probe: Probe
) -> None:
    transitions, events = probe.listen("env/transition"), probe.listen("episode")
    actions, credit = probe.publisher("action"), probe.publisher("flow/credit")
    graph.start_environment(
        "toy:make_robot", num_envs=1, mode="asynchronous", control_period_s=0.05, max_action_age_s=60.0
    )
    wait_until("the environment", lambda: transitions and actions.get_subscription_count())
    wait_until("matching", credit.get_subscription_count)
    message = ActionBatch(num_envs=1, action_dim=3, chunk_length=1)
    message.action = convert.to_field(np.full(3, 0.25, np.float32))
    actions.publish(message)  # of a person: it ages from its arrival

    def told() -> list[str]:
        return [line for line in graph.log("/wm/environment").splitlines() if line.startswith("told")]

    def grant(seq: int) -> None:
        session = transitions[-1].session
        credit.publish(Credit(consumer="/wm/idle", topic="env/transition", stream_session=session, granted_seq=seq))

    wait_until("motion", lambda: "told 0.25" in told())
    grant(0)
    wait_until("the count", lambda: value(probe, "steps_left_out") > 1)
    assert told()[-2:] == ["told 0.25", "told 0"], "it holds once"
    assert "a robot holds: waiting for /wm/idle" in probe.diagnostics["/wm/environment"].message
    assert probe.diagnostics["/wm/environment"].level == DiagnosticStatus.WARN
    grant(2**40)
    wait_until("motion again", lambda: told()[-1] == "told 0.25")
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    assert probe.call(ChangeState, "environment/change_state", request).success
    assert told()[-2:] == ["told 0.25", "told 0"]
    wait_until("ends", lambda: sum(e.termination_reason == EpisodeEvent.REASON_DEACTIVATED for e in events))


def test_a_rollout_ends_with_the_emergency_stop_as_its_reason(graph: Graph, probe: Probe) -> None:
    transitions, estop = probe.listen("env/transition"), probe.publisher("safety/estop")
    graph.start_environment("toy:make_long_environment", num_envs=N)
    graph.start_policy()
    wait_until("both readers of both nodes", lambda: estop.get_subscription_count() >= 4)
    handle = probe.send(probe.action(Rollout, "rollout"), Rollout.Goal(steps=100_000, reset=True))
    wait_until("steps", lambda: len(transitions) > 5)
    estop.publish(Bool(data=True))
    result = probe.finish(handle)
    assert result.termination_reason == Rollout.Result.FAILED
    assert "the emergency stop is set; publish false on safety/estop to go on" in result.message
    wait_until("the condition", lambda: "emergency stop is set" in probe.diagnostics["/wm/policy"].message)
