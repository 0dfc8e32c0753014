"""Publishers that number their messages, and that end when the last ones have arrived."""

import time
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
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
        node: a ManagedNode, whose diagnostics count what is not sent.
        qos: instead of the row's profile.
    """

    def __init__(self, node: Any, name: str, session: int, qos: QoSProfile | None = None) -> None:
        row = topic(name)
        self._node, self._name = node, name
        self.publisher = node.create_publisher(row.type, row.name, qos or row.qos)
        self._session, self.next_seq = session, 0

    def enter(self, session: int) -> None:
        """Number from 0 again where the session is another one."""
        if session != self._session:
            self._session, self.next_seq = session, 0

    def publish(self, message: Any) -> None:
        """Publish, or count what the middleware refuses: its readers see the gap."""
        message.session, message.seq = self._session, self.next_seq
        self.next_seq += 1
        try:
            self.publisher.publish(message)
        except RCLError as error:
            text = f"{self._name} not sent, is a reader stuck? {error}"
            self._node.diagnostics.count(f"unsent {self._name}", text=text)


def destroy_when_heard(node: Node, publishers: list[Publisher]) -> None:
    """Destroy a node's publishers, and empty the list, once what they sent has arrived or LAST_WORD_S have passed."""
    until = time.monotonic() + LAST_WORD_S
    for publisher in publishers:
        wait_until_heard(publisher, until - time.monotonic())
    while publishers:
        node.destroy_publisher(publishers.pop())


def wait_until_heard(publisher: Publisher, longest_s: float = LAST_WORD_S) -> None:
    """Wait until all whom a reliable publisher reaches have what it sent."""
    publisher.wait_for_all_acked(Duration(seconds=max(longest_s, 0.0)))
