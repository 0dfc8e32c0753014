"""A storm of odd messages on every topic and service of running nodes, with each one accounted for."""

import threading
import time
from collections import Counter, defaultdict
from copy import copy
from dataclasses import dataclass, field
from typing import Any

from action_msgs.srv import CancelGoal
from graph.harness import MATCH_S, RESEND_S, Probe, wait_until
from graph.raw_publisher import RawPublisher
from lifecycle_msgs.srv import GetState
from message_generator import MessageGenerator, interface
from rclpy._rclpy_pybind11 import RCLError
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Bool

from wm_nodes.ros.qos import TOPICS

ANSWER_S = 20.0
"""Longest time in which a node answers while the storm blows on two busy cores."""
COUNTED_S = 10.0
"""Longest time until the last messages are in the counters: diagnostics come once a second."""
MAX_SHOWN = 2000
ESTOP = "/wm/safety/estop"
LEFT_OUT = ("/change_state", "/set_parameters_atomically")
"""Services by which anybody may end, or change, a node."""
EVERYBODY = ("run/state", "run/links", "flow/credit")
"""Topics on which the nodes themselves speak all the time."""
FEW = 2
GOALS_END_S = 1.0
"""Longest time until a cancelled goal of these small loops has ended."""
LARGE_BYTES, LARGE_S = 2**14, 0.1
"""A message in fragments is complete only after the small ones that were sent behind it."""


@dataclass
class _Topic:
    kind: type[Any]
    readers: list[str]
    publisher: Any
    depth: int
    sent: int = 0
    seen: int = 0
    """By a subscription of this process, so those of the graph's own publishers too."""


@dataclass
class _Service:
    kind: type[Any]
    node: str
    client: Any
    requests: RawPublisher


@dataclass
class _Batch:
    number: int
    sent: dict[str, list[tuple[str, type[Any], bytes]]] = field(default_factory=lambda: defaultdict(list))


class Storm:
    """Every topic that the given nodes subscribe to and every service that they serve, actions among them.

    Args:
        nodes: fully qualified names.
    """

    def __init__(self, probe: Probe, nodes: list[str], generator: MessageGenerator) -> None:
        self._probe, self._nodes, self._generator = probe, nodes, generator
        self._node = probe.node
        self._learning = True
        self.topics: dict[str, _Topic] = {}
        self.services: dict[str, _Service] = {}
        self._replies: dict[str, RawPublisher] = {}
        """While the storm blows: a client takes a service with two answerers for none."""
        self._states = {name: self._node.create_client(GetState, f"{name}/get_state") for name in nodes}
        for name in nodes:
            wait_until(f"{name}", self._states[name].service_is_ready, 30)
        time.sleep(MATCH_S)
        for name in nodes:
            space, _, base = name.rpartition("/")
            for topic, kinds in self._node.get_subscriber_names_and_types_by_node(base, space):
                self._add_topic(topic, kinds[0], name)
            for service, kinds in self._node.get_service_names_and_types_by_node(base, space):
                if not service.endswith(LEFT_OUT):
                    self._add_service(service, kinds[0], name)
        wait_until("services", lambda: all(s.client.service_is_ready() for s in self.services.values()))
        topics = self.topics.values()
        wait_until("readers", lambda: all(t.publisher.get_subscription_count() > len(t.readers) for t in topics))
        time.sleep(MATCH_S)
        self.total = 0
        self.lost_answers: list[str] = []

    def _add_topic(self, name: str, kind: str, reader: str) -> None:
        if name in self.topics:
            self.topics[name].readers.append(reader)
            return
        ends = [end.qos_profile for end in self._node.get_subscriptions_info_by_topic(name)]
        latched = any(end.durability == DurabilityPolicy.TRANSIENT_LOCAL for end in ends)
        qos = QoSProfile(
            reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=100,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        listened = copy(qos)
        listened.history = HistoryPolicy.KEEP_ALL
        message_type = interface(kind)
        topic = _Topic(message_type, [reader], self._node.create_publisher(message_type, name, qos), 1)
        self.topics[name] = topic

        def hear(data: bytes) -> None:
            topic.seen += 1
            if self._learning:
                self._generator.learn(message_type, data)

        self._node.create_subscription(message_type, name, hear, listened, raw=True)

    def _add_service(self, name: str, kind: str, server: str) -> None:
        service = interface(kind)
        self.services[name] = _Service(
            service, server, self._node.create_client(service, name),
            RawPublisher(self._node, service.Request, f"rq{name}Request"),
        )

    def learn(self, *messages: Any) -> None:
        """Take requests as plausible ones."""
        for message in messages:
            self._generator.learn(type(message), bytes(serialize_message(message)))

    def release_emergency_stop(self) -> None:
        self.topics[ESTOP].publisher.publish(Bool(data=False))

    def wait_for_more(self, node: str, topic: str, number: int = 5) -> None:
        """Wait until a node has handled further messages of a topic; else name what all nodes say of themselves."""
        before = self._counters()[node].get(f"received {topic}", 0)
        deadline = time.monotonic() + ANSWER_S
        while self._counters()[node].get(f"received {topic}", 0) < before + number:
            if time.monotonic() > deadline:
                said = {n: {v.key: v.value for v in self._probe.diagnostics[n].values} for n in self._nodes}
                raise AssertionError(f"{node} got no more {topic}: {said}")
            time.sleep(0.2)

    def blow(self, count: int, limit_s: float) -> None:
        """Send `count` messages in batches, after each of which every node must be there and answer."""
        self._learning = False
        for name, service in self.services.items():
            self._replies[name] = RawPublisher(self._node, service.kind.Response, f"rr{name}Reply")
        time.sleep(2.5)
        self._before = self._counters()
        self._seen = {name: topic.seen for name, topic in self.topics.items()}
        began, number = time.monotonic(), 0
        while self.total < count:
            number += 1
            assert time.monotonic() - began < limit_s, f"{self.total} of {count} messages in {limit_s:g} s"
            self._send(_Batch(number))
        for publisher in self._replies.values():
            publisher.destroy()
        self._replies.clear()
        self._end_goals()
        if ESTOP in self.topics:
            self.release_emergency_stop()

    def _end_goals(self) -> None:
        """Cancel what the last messages have started, until nothing is."""
        cancel = [name for name, service in self.services.items() if service.kind is CancelGoal]
        for name in cancel:  # all at once: a goal that goes on while another one ends would get more done
            self.services[name].client.call_async(CancelGoal.Request())
        for name in cancel:
            wait_until(
                f"the end of the goals of {name}",
                lambda n=name: not self._probe.call(CancelGoal, n, CancelGoal.Request()).goals_canceling,  # type: ignore[misc]
            )
        time.sleep(GOALS_END_S)

    def close(self) -> None:
        """Destroy what rclpy does not know of; before the probe is closed."""
        for publisher in [*self._replies.values(), *(service.requests for service in self.services.values())]:
            publisher.destroy()

    def _send(self, batch: _Batch) -> None:
        answers: list[tuple[str, str, Any, Any]] = []
        large = False
        for name, topic in self.topics.items():
            data = self._generator.next(topic.kind)
            for reader in topic.readers:
                batch.sent[reader].append((name, topic.kind, data))
            try:
                topic.publisher.publish(data)
            except RCLError:  # longer than a message of a type without strings and lists can be
                continue
            topic.sent += 1
            self.total += 1
            large = large or len(data) > LARGE_BYTES
        if large:
            time.sleep(LARGE_S)
        for name, service in self.services.items():
            kind = service.kind.Request
            request = self._generator.request(kind)
            for part in ("goal_id", "goal_info"):
                if hasattr(request, part) and service.kind is not CancelGoal:
                    request.goal_id.uuid = list(self._generator.rng.randbytes(16))
            batch.sent[service.node].append((name, kind, bytes(serialize_message(request))))
            answers.append((name, service.node, service.client, request))
            data = self._generator.next_of_service(kind)
            batch.sent[service.node].append((name, kind, data))
            service.requests.publish(data)
            self._replies[name].publish(self._generator.next_of_service(service.kind.Response))
            self.total += 3
            if service.kind is CancelGoal:
                service.client.call_async(CancelGoal.Request())
        for name in self._nodes:
            answers.append((f"{name}/get_state", name, self._states[name], GetState.Request()))
        futures = [client.call_async(request) for _, _, client, request in answers]
        for (name, node, client, request), future in zip(answers, futures, strict=True):
            if not _is_done(future, RESEND_S):
                self.lost_answers.append(f"{name} in batch {batch.number}")
                if not _is_done(client.call_async(request), ANSWER_S):
                    told = "\n".join(_describe(*message) for message in batch.sent[node])
                    raise AssertionError(f"{node} does not answer {name} in batch {batch.number}; it was sent\n{told}")

    def _counters(self) -> dict[str, dict[str, int]]:
        """received, dropped by node."""
        return {
            node: {
                entry.key: int(entry.value) for entry in self._probe.diagnostics[node].values
                if entry.key.startswith(("received ", "dropped ")) and " by " not in entry.key
            }
            for node in self._nodes
        }

    def assert_counted(self, *, quiet: bool = True) -> None:
        """Assert that every message that came to a node's topic was handled or dropped there.

        quiet: the nodes publish nothing by themselves, so that the numbers are equal.
        """
        deadline = time.monotonic() + COUNTED_S
        while wrong := self._uncounted(quiet):
            assert time.monotonic() < deadline, "\n".join(wrong)
            time.sleep(0.2)

    def _uncounted(self, quiet: bool) -> list[str]:
        now, wrong = self._counters(), []
        for name, topic in self.topics.items():
            for reader in topic.readers:
                if "/_action/" in name:  # rclpy's own
                    continue
                key = name.removeprefix(reader.rpartition("/")[0] + "/")
                more = Counter(now[reader])
                more.subtract(self._before[reader])
                counted = more[f"received {key}"] + more[f"dropped {key}"]
                came = topic.seen - self._seen[name]
                alone = quiet and not key.endswith(EVERYBODY) and (came == topic.sent or not 0 < _depth(key) <= FEW)
                right = counted == came if alone else counted >= topic.sent
                if not right:
                    wrong.append(f"{reader} {key}: {topic.sent} sent, {came} came, {counted} counted")
        return wrong


def _depth(key: str) -> int:
    """How many messages a subscriber keeps; where these are few, a node's own may replace the storm's. 0: all."""
    row = TOPICS.get(key)
    return row.reader_qos.depth if row is not None else 0


def _is_done(future: Any, timeout_s: float) -> bool:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    return done.wait(timeout_s)


def _describe(name: str, kind: type[Any], data: bytes) -> str:
    """A message by topic, bytes, and what rclpy makes of them."""
    try:
        read = repr(deserialize_message(data, kind))
    except Exception:
        read = "cannot be read"
    return f"  {name} {data[:MAX_SHOWN].hex()}{'...' if len(data) > MAX_SHOWN else ''}\n    {read:.{MAX_SHOWN}}"
