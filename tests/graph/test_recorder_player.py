"""Recorder and player as processes over DDS: bytes in, the same bytes out."""

import json
import os
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from deadlines import within
from diagnostic_msgs.msg import DiagnosticArray
from graph.harness import MATCH_S
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile
from recording_graph import NUM_ENVS, Graph, assert_same_rollout, write
from recording_samples import make_spec
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from wm_msgs.action import Replay
from wm_msgs.msg import Credit, ErrorCode, TransitionBatch
from wm_msgs.srv import PlayNext, Seek, SetRate, StartRecording, StopRecording
from wm_nodes.launching.runner import clean_shared_memory
from wm_nodes.nodes.recorder.qos import message_class
from wm_nodes.recording import Bag, read_episodes, read_rollouts, recover, topics
from wm_nodes.recording import messages as m
from wm_nodes.ros import qos as table

pytestmark = [pytest.mark.graph, pytest.mark.alone]

TOPICS = [topics.SPEC, topics.IMAGES, topics.TRANSITION, topics.REWARD, topics.EPISODE]
Streams = dict[str, list[bytes]]


class Peer:
    """This process's node in the graph's namespace, and the node under test as a child process."""

    def __init__(self, domain: int, module: str, folder: Path, **parameters: object) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node("peer", namespace="/wm", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        arguments = [f"{name}:={json.dumps(value)}" for name, value in {"run_dir": str(folder), **parameters}.items()]
        command = [sys.executable, "-m", f"wm_nodes.nodes.{module}", "--ros-args", "-r", "__ns:=/wm"]
        for argument in arguments:
            command += ["-p", argument]
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.process = subprocess.Popen(command, env=environment)

    def wait(self, ready: Callable[[], Any], what: str, timeout_s: float = 30.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not ready():
            assert self.process.poll() is None or what == "end", f"the node ended while waiting for {what}"
            assert time.monotonic() < deadline, f"no {what} within {timeout_s} s"
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, kind: Any, name: str, **fields: Any) -> Any:
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, name)
        self.match()
        future = client.call_async(kind.Request(**fields))
        self.wait(future.done, f"answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def match(self) -> None:
        """Spin for as long as the node may take to match what is new here (harness.MATCH_S)."""
        until = time.monotonic() + MATCH_S
        while time.monotonic() < until:
            self.executor.spin_once(timeout_sec=0.05)

    def counts(self) -> dict[str, str]:
        """What the node's /diagnostics say from now on; the dictionary grows while this process spins."""
        found: dict[str, str] = {}

        def note(message: DiagnosticArray) -> None:
            found.update((value.key, value.value) for status in message.status for value in status.values)

        self.node.create_subscription(DiagnosticArray, "/diagnostics", note, 10)
        return found

    def end(self, how: int = signal.SIGTERM) -> int:
        self.process.send_signal(how)
        return self.process.wait(20)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


Start = Callable[..., Peer]


@pytest.fixture
def peer() -> Iterator[Start]:
    peers: list[Peer] = []

    def start(*arguments: Any, **parameters: Any) -> Peer:
        peers.append(Peer(*arguments, **parameters))
        return peers[-1]

    yield start
    for each in peers:
        each.close()
    clean_shared_memory()


def padded(streams: Streams) -> Streams:
    """RTPS fills a payload up to a multiple of four bytes; everything before that is compared."""
    return {name: [data + bytes(-len(data) % 4) for data in messages] for name, messages in streams.items()}


def live_graph(*rollouts: int) -> Graph:
    graph = Graph(make_spec(num_envs=NUM_ENVS))
    for version, steps in enumerate(rollouts, start=1):
        graph.rollout(version, steps)
    graph.flush_rewards(10**9)
    return graph


def publish(peer: Peer, graph: Graph, *, pause_s: float = 0.0, stop: Callable[[], bool] = lambda: False) -> Streams:
    """Publish the graph's messages as bytes, at the pace of the recorder's credit; return what was sent."""
    publishers = {
        topic.name: peer.node.create_publisher(table.topic(topic.name).type, topic.name, table.topic(topic.name).qos)
        for topic in TOPICS
    }
    granted = [15]
    peer.node.create_subscription(
        Credit,
        "flow/credit",
        lambda message: granted.append(message.granted_seq) if message.topic == "env/transition" else None,
        10,
    )
    for name, publisher in publishers.items():
        peer.wait(publisher.get_subscription_count, f"subscription of {name}")
    peer.match()  # the recorder's side of it
    sent: Streams = {topic.name: [] for topic in TOPICS}
    for topic, message, _ in graph.published:
        if topic is topics.TRANSITION:
            peer.wait(lambda seq=message.seq: granted[-1] >= seq, "credit")
        data = m.serialize(message)
        publishers[topic.name].publish(data)
        sent[topic.name].append(data)
        peer.executor.spin_once(timeout_sec=pause_s)
        if stop():
            break
    return sent


def recorded(path: Path) -> Streams:
    streams: Streams = {topic.name: [] for topic in TOPICS}
    with Bag(path) as bag:
        for name, _, data in bag.messages():
            if name.removeprefix("/wm/") in streams:
                streams[name.removeprefix("/wm/")].append(bytes(data))
    return streams


def test_the_recorder_writes_every_byte_and_the_bag_gives_back_the_rollouts(
    domain: int, tmp_path: Path, peer: Start
) -> None:
    recorder = peer(domain, "recorder_node", tmp_path, bag_uri="bags/live", min_free_mib=16)
    graph = live_graph(40, 30)
    sent = publish(recorder, graph)
    time.sleep(1.0)
    stopped = recorder.call(StopRecording, "recorder/stop")
    assert stopped.error_code == ErrorCode.OK, stopped.message
    assert stopped.gaps == 0
    path = tmp_path / "bags" / "live"
    assert stopped.bag_uri == str(path)
    assert recorded(path) == padded(sent)
    for ours, theirs in zip(read_rollouts(path), graph.rollouts, strict=True):
        assert_same_rollout(ours, theirs)
    with Bag(path) as bag:
        assert bag.custom["wm.recorder_drops"] == "{}"
        assert json.loads(bag.custom["wm.spec_json"])["width"] == 12
    (row,) = json.loads((tmp_path / "bags.json").read_text())
    assert row["bag"] == "bags/live"
    assert recorder.call(StopRecording, "recorder/stop").error_code == ErrorCode.NOT_ACTIVE
    again = recorder.call(StartRecording, "recorder/start", bag_uri="bags/live")
    assert again.error_code == ErrorCode.BUSY
    assert "exists already" in again.message
    started = recorder.call(StartRecording, "recorder/start")
    assert started.bag_uri == str(tmp_path / "bags" / "bag_000")
    assert recorder.call(Trigger, "recorder/split").success
    assert recorder.end() == 0
    assert recorded(tmp_path / "bags" / "bag_000")["env/spec"] == padded(sent)["env/spec"]


def test_the_recorder_reports_exactly_the_gaps_there_were(domain: int, tmp_path: Path, peer: Start) -> None:
    recorder = peer(domain, "recorder_node", tmp_path, bag_uri="bag", min_free_mib=16)
    graph = live_graph(12)
    graph.published = [
        item for item in graph.published if item[0] is not topics.TRANSITION or item[1].seq not in (3, 4, 7)
    ]
    publish(recorder, graph)
    time.sleep(0.5)
    assert recorder.call(StopRecording, "recorder/stop").gaps == 3
    with Bag(tmp_path / "bag") as bag:
        drops = json.loads(bag.custom["wm.recorder_drops"])
    assert drops == {"/wm/env/transition": {"lost": 3, "gaps": [[7, 3, 2], [7, 7, 1]]}}


def test_what_a_flood_lost_is_what_the_recorder_reports(domain: int, tmp_path: Path, peer: Start) -> None:
    recorder = peer(domain, "recorder_node", tmp_path, bag_uri="bag", min_free_mib=16)
    publish(recorder, Graph(make_spec(num_envs=NUM_ENVS)))
    overwritten = QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=1, reliability=table.topic("env/transition").qos.reliability
    )
    flood = recorder.node.create_publisher(TransitionBatch, "env/transition", overwritten)
    recorder.wait(flood.get_subscription_count, "subscription")
    recorder.match()
    newest = [-1]

    def note(credit: Credit) -> None:
        if credit.stream_session == 9:
            newest.append(credit.received_seq)

    recorder.node.create_subscription(Credit, "flow/credit", note, 10)
    message, num_sent = TransitionBatch(session=9, action=array("f", bytes(80_000))), 2000
    flood.publish(message)
    recorder.wait(lambda: newest[-1] == 0, "first message: whatever is missing after it is a gap")
    for seq in range(1, num_sent):
        if seq == num_sent // 2:  # a reader that is busy: the writer's one place is overwritten for sure
            recorder.process.send_signal(signal.SIGSTOP)
        message.seq = seq
        flood.publish(message)
    recorder.process.send_signal(signal.SIGCONT)
    recorder.wait(lambda: newest[-1] == num_sent - 1, "last message")
    stopped = recorder.call(StopRecording, "recorder/stop")
    received = len(recorded(tmp_path / "bag")["env/transition"])
    assert 0 < received < num_sent
    assert stopped.gaps == num_sent - received


def test_a_stopped_recorder_first_takes_what_was_sent_to_it(domain: int, tmp_path: Path, peer: Start) -> None:
    recorder = peer(domain, "recorder_node", tmp_path, bag_uri="bag", min_free_mib=16)
    graph = live_graph(8)
    publish(recorder, Graph(make_spec(num_envs=NUM_ENVS)))  # one message: discovery has finished
    recorder.process.send_signal(signal.SIGSTOP)
    sent = publish(recorder, graph)
    recorder.process.send_signal(signal.SIGTERM)
    recorder.process.send_signal(signal.SIGCONT)
    assert recorder.process.wait(20) == 0
    found = recorded(tmp_path / "bag")
    assert {name: messages[-len(sent[name]) :] for name, messages in found.items()} == padded(sent)


def test_a_killed_recorder_loses_at_most_the_last_second(domain: int, tmp_path: Path, peer: Start) -> None:
    recorder = peer(domain, "recorder_node", tmp_path, bag_uri="bag", min_free_mib=16)
    graph = live_graph(400)
    began = time.monotonic()
    sent = publish(recorder, graph, pause_s=0.005, stop=lambda: time.monotonic() - began > 6)
    killed_ns = time.time_ns()
    recorder.end(signal.SIGKILL)
    report = recover(tmp_path / "bag.partial")
    found = recorded(report.bag)
    for name, messages in found.items():
        assert messages == padded(sent)[name][: len(messages)]
    with Bag(report.bag) as bag:
        assert killed_ns - bag.end_ns < 1_000_000_000
    assert len(list(read_episodes(report.bag))) > 0


def test_a_full_disk_refuses_the_recording_with_one_clear_error(domain: int, tmp_path: Path, peer: Start) -> None:
    recorder = peer(domain, "recorder_node", tmp_path, record_at_start=False, min_free_mib=10**9)
    counts = recorder.counts()
    answer = recorder.call(StartRecording, "recorder/start")
    assert answer.error_code == ErrorCode.IO_ERROR
    assert "free some space" in answer.message
    recorder.wait(lambda: counts.get("refused_starts") == "1", "count")
    assert not (tmp_path / "bags").exists()


class Listener:
    """Collects the bytes of the played topics and the ticks of /clock."""

    def __init__(self, peer: Peer, path: Path) -> None:
        self.streams: Streams = {}
        self.order: list[str] = []
        self.ticks: list[int] = []
        with Bag(path) as bag:
            connections = [c for c in bag.connections if c.msgcount]
        for connection in connections:
            row = table.topic(connection.topic.removeprefix("/wm/"))
            profile = QoSProfile(
                history=HistoryPolicy.KEEP_ALL,
                depth=0,
                reliability=row.qos.reliability,
                durability=row.qos.durability,
            )
            name = connection.topic.removeprefix("/wm/")
            peer.node.create_subscription(
                message_class(connection.msgtype), connection.topic, self.keep(name), profile, raw=True
            )
        peer.node.create_subscription(
            Clock, "/clock", lambda tick: self.ticks.append(m.stamp_ns(tick.clock)), table.CLOCK
        )

    def keep(self, name: str) -> Callable[[bytes], None]:
        def callback(data: bytes) -> None:
            self.streams.setdefault(name, []).append(bytes(data))
            self.order.append(name)

        return callback


def replay(peer: Peer, feedback: list[Any], **goal: Any) -> tuple[Any, Any]:
    client = ActionClient(peer.node, Replay, "replay")
    peer.wait(client.server_is_ready, "replay server")
    peer.match()
    accepted = client.send_goal_async(
        Replay.Goal(publish_clock=True, **goal), feedback_callback=lambda message: feedback.append(message.feedback)
    )
    peer.wait(accepted.done, "goal answer")
    assert accepted.result().accepted
    return accepted.result(), accepted.result().get_result_async()


def test_the_player_publishes_the_same_bytes_in_order_with_the_clock(domain: int, tmp_path: Path, peer: Start) -> None:
    path = write(tmp_path / "bag", live_graph(60))
    player = peer(domain, "player_node", tmp_path)
    listener = Listener(player, path)
    feedback: list[Any] = []
    _, done = replay(player, feedback, bag_uri="bag", rate=0.2)
    player.wait(done.done, "result", 60)
    result = done.result().result
    expected = recorded(path)
    assert result.termination_reason == Replay.Result.FINISHED, result.message
    assert result.messages == sum(map(len, expected.values()))
    player.wait(lambda: len(listener.order) >= result.messages, "last message")
    assert padded(listener.streams) == {name: data for name, data in padded(expected).items() if data}
    assert listener.ticks == sorted(listener.ticks)
    with Bag(path) as bag:
        assert listener.ticks[0] >= bag.start_ns
        player.wait(lambda: listener.ticks[-1] == bag.end_ns, "last tick")
    assert len(feedback) > 1
    assert [f.position for f in feedback] == sorted(f.position for f in feedback)
    assert player.end() == 0


def test_the_player_pauses_steps_seeks_and_is_cancelled(domain: int, tmp_path: Path, peer: Start) -> None:
    path = write(tmp_path / "bag", live_graph(60))
    total = sum(len(data) for data in recorded(path).values())
    player = peer(domain, "player_node", tmp_path, start_paused=True)
    listener = Listener(player, path)
    feedback: list[Any] = []
    handle, done = replay(player, feedback, bag_uri="bag", rate=1.0)
    player.wait(lambda: feedback, "feedback")
    assert player.call(PlayNext, "player/play_next", num_messages=7).played == 7
    player.wait(lambda: len(listener.order) == 7, "seven messages")
    counts = player.counts()
    assert player.call(SetRate, "player/set_rate", rate=-1.0).error_code == ErrorCode.OUT_OF_RANGE
    assert "lasts" in player.call(Seek, "player/seek", position=1e6).message
    player.wait(lambda: counts.get("refused_requests") == "2", "count")
    assert player.call(SetRate, "player/set_rate", rate=100.0).error_code == ErrorCode.OK
    assert player.call(Seek, "player/seek", position=0.0).error_code == ErrorCode.OK
    assert player.call(PlayNext, "player/play_next", num_messages=1).played == 1
    player.wait(lambda: len(listener.order) == 8, "the first message again")
    assert listener.streams["env/spec"][0] == listener.streams["env/spec"][1]
    assert player.call(Trigger, "player/resume").success
    player.wait(done.done, "result", 60)
    assert done.result().result.messages == 8 + total - 1
    handle, done = replay(player, feedback, bag_uri="bag", rate=0.001, topics=["env/spec", "reward"])
    began = time.monotonic()
    cancelled = handle.cancel_goal_async()
    player.wait(cancelled.done, "cancel answer")
    player.wait(done.done, "cancelled result")
    assert done.result().result.termination_reason == Replay.Result.CANCELED
    assert time.monotonic() - began < within(1.0)


def test_a_bag_that_cannot_be_played_is_a_failed_goal_with_the_reason(domain: int, tmp_path: Path, peer: Start) -> None:
    path = write(tmp_path / "bag", live_graph(3))
    file = path / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    player = peer(domain, "player_node", tmp_path)
    counts = player.counts()
    for goal, text in (
        ({"bag_uri": "bag"}, "damaged"),
        ({"bag_uri": "nothing"}, "no bag at"),
        ({}, "no bag named"),
    ):
        _, done = replay(player, [], rate=1.0, **goal)
        player.wait(done.done, "result")
        assert done.result().result.termination_reason == Replay.Result.FAILED
        assert text in done.result().result.message
    player.wait(lambda: counts.get("failed_goals") == "3", "count")
