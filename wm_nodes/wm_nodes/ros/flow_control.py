"""Back-pressure for keep-all streams: a consumer grants sequence numbers, the producer does not run ahead of them."""

import threading
import time

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from wm_msgs.msg import Credit
from wm_nodes.recording.topics import CREDIT_WINDOW
from wm_nodes.ros.qos import topic
from wm_nodes.ros.sequence_numbers import MAX_NUMBER, GapTracker

SILENT_S = 5.0
"""A consumer that has held the producer up for so long without a word is dropped."""

REPEAT_S = 1.0

MAX_CONSUMERS = 64


class ProducerCredits:
    """The producer's side for one stream: who may be waited for, and whether the next message may go out.

    With no consumers there is nothing to wait for. Times are monotonic, in s; pass `now` in tests. Thread-safe: the
    executor takes in messages while a worker asks.
    """

    def __init__(self, topic_name: str, session: int) -> None:
        self._topic_name, self._session = topic_name, session
        self._consumers: dict[str, tuple[Credit, float]] = {}
        """The newest message of each, and when it came."""
        self._lock = threading.Lock()

    def note(self, message: Credit, now: float | None = None) -> None:
        """Take in a Credit message; those of other streams or sessions are ignored."""
        if message.topic != self._topic_name or message.stream_session != self._session:
            return
        with self._lock:
            self._consumers.pop(message.consumer, None)  # the newest last
            self._consumers[message.consumer] = message, time.monotonic() if now is None else now
            if len(self._consumers) > MAX_CONSUMERS:
                del self._consumers[next(iter(self._consumers))]

    def remove(self, consumer: str) -> None:
        with self._lock:
            self._consumers.pop(consumer, None)

    def blocking_consumers(self, next_seq: int) -> list[str]:
        """Return the consumers that have not granted `next_seq` yet; empty: publish."""
        with self._lock:
            return self._blocking(next_seq)

    def drop_silent(self, next_seq: int, now: float | None = None) -> list[str]:
        """Drop and return the consumers that hold the producer up and were silent for SILENT_S."""
        now = time.monotonic() if now is None else now
        with self._lock:
            gone = [name for name in self._blocking(next_seq) if now - self._consumers[name][1] > SILENT_S]
            for name in gone:
                del self._consumers[name]
        return gone

    @property
    def consumers(self) -> list[str]:
        with self._lock:
            return sorted(self._consumers)

    def _blocking(self, next_seq: int) -> list[str]:
        return [name for name, (credit, _) in self._consumers.items() if credit.granted_seq < next_seq]


class ConsumerCredits:
    """The consumer's side for one stream: grants a window ahead of what was consumed.

    below: relative namespace of the producer with a slash at its end, e.g. "sim/"; empty: the node's own.

    Grants go out each quarter window, and once a second, so that a restarted producer learns of its consumers.
    While `withheld`, the newest grant of the session is repeated: the producer waits and knows that someone is there.
    """

    def __init__(self, node: Node, topic_name: str, window: int = CREDIT_WINDOW, *, below: str = "") -> None:
        self._node, self._topic_name, self._window = node, topic_name, window
        row = topic("flow/credit")
        self._publisher = node.create_publisher(Credit, below + row.name, row.qos)
        self._timer = node.create_timer(REPEAT_S, self.grant, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._tracker: GapTracker | None = None
        self._since_grant = 0
        self._granted: tuple[int, int] | None = None
        self.withheld = False

    def record_consumed(self, tracker: GapTracker) -> None:
        """Note that one message of the stream was dealt with; `tracker` has already observed it."""
        first = self._tracker is None or tracker.received <= 1
        self._tracker = tracker
        self._since_grant += 1
        if first or self._since_grant >= self._window // 4:
            self.grant()

    def withhold(self, withheld: bool) -> None:
        """Stop granting more, or go on."""
        if withheld != self.withheld:
            self.withheld = withheld
            self.grant()

    def grant(self) -> None:
        """Publish the present grant; nothing before the first message."""
        if self._tracker is None or self._tracker.session is None:
            return
        self._since_grant = 0
        session = self._tracker.session
        granted = min(self._tracker.last_seq + self._window, MAX_NUMBER)
        if self.withheld and self._granted is not None and self._granted[0] == session:
            granted = min(granted, self._granted[1])  # a player that went back is held sooner
        self._granted = session, granted
        message = Credit(
            consumer=self._node.get_fully_qualified_name(), topic=self._topic_name, stream_session=session,
            received_seq=max(self._tracker.last_seq, 0), granted_seq=granted, lost_total=self._tracker.lost,
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def close(self) -> None:
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
