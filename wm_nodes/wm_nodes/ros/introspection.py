"""Service introspection (REP 2012): requests and answers of a node's services, to be seen and recorded as topics."""

from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service_introspection import ServiceIntrospectionState

STATES = {
    "off": ServiceIntrospectionState.OFF,
    "metadata": ServiceIntrospectionState.METADATA,
    "contents": ServiceIntrospectionState.CONTENTS,
}
EVENTS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=10)


def introspect(node: Node, service: Any, state: str) -> None:
    """Publish a service's events on <service>/_service_event: none (off), who and when (metadata), or everything."""
    service.configure_introspection(node.get_clock(), EVENTS, STATES[state])
