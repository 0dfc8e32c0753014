"""The publishers of a node: some number their messages, and all wait a while for the last ones to arrive."""

import time
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from wm_nodes.ros.qos import topic

LAST_WORD_S = 1.0
"""How long a node that leaves waits for those who hear it: a publisher that is gone delivers nothing."""


class StampedPublisher:
    """A publisher of one row of the QoS table that numbers its messages (session, seq).

    Args:
        qos: instead of the row's profile.
    """

    def __init__(self, node: Node, name: str, session: int, qos: QoSProfile | None = None) -> None:
        row = topic(name)
        self.publisher = node.create_publisher(row.type, row.name, qos or row.qos)
        self._session, self.next_seq = session, 0

    def enter(self, session: int) -> None:
        """Number from 0 again where the session is another one."""
        if session != self._session:
            self._session, self.next_seq = session, 0

    def publish(self, message: Any) -> None:
        message.session, message.seq = self._session, self.next_seq
        self.next_seq += 1
        self.publisher.publish(message)


class OwnPublishers:
    """The publishers of rows of the QoS table that a node has until end()."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._all: list[Publisher] = []

    def numbering(self, name: str, session: int, qos: QoSProfile | None = None) -> StampedPublisher:
        """One for a row, or with another profile, whose messages are numbered."""
        publisher = StampedPublisher(self._node, name, session, qos)
        self._all.append(publisher.publisher)
        return publisher

    def plain(self, name: str) -> Publisher:
        """One for a row whose messages have no (session, seq)."""
        row = topic(name)
        self._all.append(self._node.create_publisher(row.type, row.name, row.qos))
        return self._all[-1]

    def end(self) -> None:
        """Destroy them once what they sent has arrived, or LAST_WORD_S have passed."""
        until = time.monotonic() + LAST_WORD_S
        for publisher in self._all:
            wait_until_heard(publisher, until - time.monotonic())
        while self._all:
            self._node.destroy_publisher(self._all.pop())


def wait_until_heard(publisher: Publisher, longest_s: float = LAST_WORD_S) -> None:
    """Wait until all whom a reliable publisher reaches have what it sent."""
    publisher.wait_for_all_acked(Duration(seconds=max(longest_s, 0.0)))
