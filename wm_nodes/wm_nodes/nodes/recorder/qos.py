"""QoS profiles between rclpy and a bag's metadata."""

import importlib
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from wm_nodes.recording.messages import NS_PER_S


def recorded_qos(profile: QoSProfile) -> Qos:
    """The profile of a publisher as a bag holds it."""

    def time_of(duration: Duration) -> QosTime:
        return QosTime(*divmod(duration.nanoseconds, NS_PER_S))

    return Qos(
        QosHistory[profile.history.name], profile.depth, QosReliability[profile.reliability.name],
        QosDurability[profile.durability.name], time_of(profile.deadline), time_of(profile.lifespan),
        QosLiveliness[profile.liveliness.name], time_of(profile.liveliness_lease_duration),
        profile.avoid_ros_namespace_conventions,
    )


def offered_qos(recorded: list[Qos]) -> QoSProfile:
    """What to publish a recorded topic with; reliable keep-all where the bag says nothing. One publisher stands in for
    all that were recorded, and keeps as much as they did.

    Liveliness leases are left out: the player does not stand in for the node that gave the promise.
    """
    if not recorded:
        return QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0, reliability=ReliabilityPolicy.RELIABLE)
    first = recorded[0]

    def known(kind: Any, name: str, fallback: Any) -> Any:
        return kind[name] if name not in ("UNKNOWN", "SYSTEM_DEFAULT", "BEST_AVAILABLE") else fallback

    return QoSProfile(
        history=known(HistoryPolicy, first.history.name, HistoryPolicy.KEEP_ALL),
        depth=sum(qos.depth for qos in recorded),
        reliability=known(ReliabilityPolicy, first.reliability.name, ReliabilityPolicy.RELIABLE),
        durability=known(DurabilityPolicy, first.durability.name, DurabilityPolicy.VOLATILE),
        liveliness=LivelinessPolicy.AUTOMATIC,
    )


def message_class(msgtype: str) -> type[Any]:
    """The Python class of e.g. wm_msgs/msg/EnvSpec.

    Raises:
        ValueError: its package is not installed.
    """
    package = msgtype.partition("/")[0]
    try:
        package, kind, name = msgtype.split("/")
        message_type: type[Any] = getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError, ValueError):
        raise ValueError(f"message type {msgtype} is not installed; install or build {package}") from None
    return message_type
