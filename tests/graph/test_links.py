"""A rollout waits until nobody can miss its first messages; the recorder has them all, and their stamps agree."""

import time
from typing import Any

import pytest
import rclpy
from graph.harness import Graph, Probe, wait_until
from rclpy.executors import SingleThreadedExecutor

from wm_msgs.action import Rollout
from wm_msgs.srv import StopRecording
from wm_nodes.recording import Bag
from wm_nodes.recording.messages import stamp_ns
from wm_nodes.ros.qos import topic

pytestmark = pytest.mark.graph
STEPS = 10


@pytest.mark.slow
def test_a_recorder_that_starts_last_has_every_message_of_the_first_rollout(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    graph.start_policy(await_nodes=["environment", "recorder"])
    client = probe.action(Rollout, "rollout")
    wait_until("the policy", lambda: probe.value("/wm/policy", "state") == "active")
    handle = probe.send(client, Rollout.Goal(steps=STEPS, reset=True, seed=1))
    graph.start("recorder")
    assert probe.finish(handle, 60).termination_reason == Rollout.Result.FINISHED
    wait_until("the recorder's last message", lambda: int(probe.value("/wm/recorder", "messages") or 0) >= 3 * STEPS)
    stopped = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
    assert stopped.gaps == 0
    with Bag(graph.folder / stopped.bag_uri) as bag:
        counts = {name: bag.count(f"/wm/{name}") for name in ("env/image", "env/transition", "action", "env/spec")}
    assert counts == {"env/image": STEPS + 1, "env/transition": STEPS + 1, "action": STEPS, "env/spec": 1}


@pytest.mark.slow
def test_what_concerns_one_observation_has_its_wall_time_on_every_topic(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    graph.start("recorder")
    graph.start_policy(await_nodes=["environment", "recorder", "reward_evaluator"])
    graph.start_reward()
    began_ns = time.time_ns()
    client = probe.action(Rollout, "rollout")
    wait_until("the policy", lambda: probe.value("/wm/policy", "state") == "active")
    result = probe.finish(probe.send(client, Rollout.Goal(steps=STEPS, reset=True, seed=1)), 60)
    assert result.termination_reason == Rollout.Result.FINISHED
    wait_until("the last reward", lambda: int(probe.value("/wm/recorder", "messages") or 0) >= 4 * STEPS)
    time.sleep(1.5)  # one reward/summary
    uri = probe.call(StopRecording, "recorder/stop", StopRecording.Request()).bag_uri
    stamps, late_s = dict[str, list[int]](), list[float]()
    with Bag(graph.folder / uri) as bag:
        for name in ("env/image", "env/transition", "env/goal", "episode", "action", "reward", "reward/summary"):
            found = [
                (time_ns, bag.decode(data, message_name(name))) for _, time_ns, data in bag.messages([f"/wm/{name}"])
            ]
            stamps[name] = [stamp_ns(message.header.stamp) for _, message in found]
            late_s += [(time_ns - stamp_ns(message.header.stamp)) / 1e9 for time_ns, message in found]
            if name == "env/transition":
                reached = [stamp_ns(message.next_stamp) for _, message in found]
    images = stamps["env/image"]
    assert began_ns < images[0] and images == sorted(set(images))
    assert reached == images
    assert stamps["env/transition"] == [images[0], *images[:-1]]
    assert stamps["reward"] == stamps["action"] == images[:-1]
    assert stamps["env/goal"] == images[:1]
    assert {*images[:1]} <= {*stamps["episode"]} <= {*images}
    assert stamps["reward/summary"][-1] > images[-1]
    assert min(late_s) > 0 and max(late_s) < 5


def message_name(name: str) -> str:
    return f"{topic(name).type.__module__.split('.')[0]}/msg/{topic(name).type.__name__}"


def test_a_rollout_without_an_awaited_node_goes_on_after_the_deadline_and_says_so(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    graph.start_policy(await_nodes=["environment", "recorder"], match_timeout_s=1.0)
    client = probe.action(Rollout, "rollout")
    wait_until("the policy", lambda: probe.value("/wm/policy", "state") == "active")
    result = probe.finish(probe.send(client, Rollout.Goal(steps=3, reset=True)))
    assert result.termination_reason == Rollout.Result.FINISHED
    wait_until("the count", lambda: int(probe.value("/wm/policy", "unmatched_nodes") or 0) >= 1)
    assert "/wm/recorder has not been heard: first messages may be missed" in graph.log("/wm/policy")


@pytest.mark.parametrize("name", ["run/state", "run/links"])
def test_a_reader_that_was_busy_finds_the_newest_word_of_every_node(domain: int, name: str) -> None:
    row, heard = topic(name), list[Any]()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    reader, writer = (rclpy.create_node(node, context=context) for node in ("reader", "writer"))
    publishers = [writer.create_publisher(row.type, name, row.qos) for _ in range(6)]
    reader.create_subscription(row.type, name, heard.append, row.reader_qos)
    wait_until("discovery", lambda: all(p.get_subscription_count() for p in publishers))
    for publisher in publishers:
        publisher.publish(row.type())
    time.sleep(0.5)  # the reader's executor is busy elsewhere
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(reader)
    for _ in range(3 * len(publishers)):
        executor.spin_once(timeout_sec=0.05)
    executor.shutdown()
    for node in (reader, writer):
        node.destroy_node()
    rclpy.shutdown(context=context)
    assert len(heard) == len(publishers)
