"""A publisher that numbers its messages."""

from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from wm_nodes.ros.qos import topic


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
