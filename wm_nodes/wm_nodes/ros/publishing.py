"""A publisher that numbers its messages."""

from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from wm_nodes.ros.qos import topic
from wm_nodes.ros.sequence_numbers import Stamper


class StampedPublisher:
    """A publisher of one row of the QoS table that numbers its messages (session, seq).

    Args:
        qos: instead of the row's profile.
    """

    def __init__(self, node: Node, name: str, session: int, qos: QoSProfile | None = None) -> None:
        row = topic(name)
        self.publisher = node.create_publisher(row.type, row.name, qos or row.qos)
        self._stamper = Stamper(session)

    @property
    def next_seq(self) -> int:
        return self._stamper.next_seq

    def publish(self, message: Any) -> int:
        """Number and publish a message; return its seq."""
        seq = self._stamper.stamp(message)
        self.publisher.publish(message)
        return seq
