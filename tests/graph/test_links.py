"""A rollout waits until nobody can miss its first messages; the recorder has them all."""

import pytest
from graph.harness import Graph, Probe, wait_until

from wm_msgs.action import Rollout
from wm_msgs.srv import StopRecording
from wm_nodes.recording import Bag

pytestmark = pytest.mark.graph
STEPS = 10


def test_a_recorder_that_starts_last_has_every_message_of_the_first_rollout(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    graph.start_policy(await_nodes=["environment", "recorder"])
    client = probe.action(Rollout, "rollout")
    wait_until("the policy", lambda: probe.value("/wm/policy", "state") == "active", 60)
    handle = probe.send(client, Rollout.Goal(steps=STEPS, reset=True, seed=1))
    graph.start("recorder")
    assert probe.finish(handle, 60).termination_reason == Rollout.Result.FINISHED
    wait_until("the recorder's last message", lambda: int(probe.value("/wm/recorder", "messages") or 0) >= 3 * STEPS)
    stopped = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
    assert stopped.gaps == 0
    with Bag(graph.folder / stopped.bag_uri) as bag:
        counts = {name: bag.count(f"/wm/{name}") for name in ("env/image", "env/transition", "action", "env/spec")}
    assert counts == {"env/image": STEPS + 1, "env/transition": STEPS + 1, "action": STEPS, "env/spec": 1}


def test_a_rollout_without_an_awaited_node_goes_on_after_the_deadline_and_says_so(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    graph.start_policy(await_nodes=["environment", "recorder"], match_timeout_s=1.0)
    client = probe.action(Rollout, "rollout")
    wait_until("the policy", lambda: probe.value("/wm/policy", "state") == "active", 60)
    result = probe.finish(probe.send(client, Rollout.Goal(steps=3, reset=True)))
    assert result.termination_reason == Rollout.Result.FINISHED
    wait_until("the count", lambda: int(probe.value("/wm/policy", "unmatched_nodes") or 0) >= 1)
    assert "/wm/recorder has not been heard: first messages may be missed" in graph.log("/wm/policy")
