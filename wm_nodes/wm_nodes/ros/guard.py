"""The guard before every callback that something from outside can reach: what cannot be read or makes no sense is
dropped, counted by topic and publisher, and logged once per kind and minute; the node goes on.

Subscriptions take bytes and are read here: the middleware drops what it cannot read itself without telling anybody.
"""

import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from rclpy.serialization import deserialize_message

from wm_msgs.msg import ErrorCode
from wm_nodes.core.errors import WireError
from wm_nodes.ros import diagnostics

LOG_PERIOD_S = 60.0
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""What rmw calls the node of an end whose name has not arrived yet."""
MAX_TEXT = 1000
"""Characters of an error that are logged: what it quotes was sent by others."""
MAX_KINDS = 256
"""Kinds that are told apart in the log, and publishers in the counters; the rest is counted together."""


class Guard:
    """Wraps the callbacks of one node.

    Args:
        node: a ManagedNode; its diagnostics and logger are used only when something is dropped.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._logged: dict[tuple[str, str], tuple[float, int]] = {}
        self._publishers: set[str] = set()
        self.handled: Counter[str] = Counter()
        """Messages and requests by name of their topic or service, without those that were dropped."""

    def wrap_subscription(
        self, name: str, message_type: type[Any] | None, callback: Callable[[Any], object]
    ) -> Callable[[bytes], None]:
        """Return the callback of a raw subscription. message_type: what `callback` takes; None: the bytes."""

        def receive(data: bytes) -> None:
            try:
                callback(data if message_type is None else deserialize_message(data, message_type))
            except Exception as error:
                self.drop(name, error, self._publishers_of(name))
            else:
                self.handled[name] += 1

        return receive

    def wrap_service(self, name: str, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a service callback that answers with an error where `callback` raises."""

        def answer(request: Any, response: Any) -> Any:
            try:
                answered = callback(request, response)
            except Exception as error:
                self.drop(name, error)
                return _refuse(type(response)(), error)
            self.handled[name] += 1
            return answered

        return answer

    def drop(self, name: str, error: Exception, publisher: str = "") -> None:
        """Count what was dropped, and log it. name: of the topic, service or action."""
        known = isinstance(error, WireError) or type(error).__name__ == "RMWError"
        text = f"{name} dropped: {_describe(error, where=not known)}"
        if publisher:
            text += f"; from {publisher}"
            self._node.diagnostics.count(f"dropped {name} by {self._bounded(publisher)}", level=diagnostics.OK)
        level = diagnostics.WARN if known else diagnostics.ERROR
        self._node.diagnostics.count(f"dropped {name}", level=level, text=text)
        code = getattr(error, "code", "")
        self._log((name, f"{type(error).__name__} {code}"), text, known)

    def _log(self, kind: tuple[str, str], text: str, known: bool) -> None:
        now = time.monotonic()
        since, more = self._logged.get(kind, (-LOG_PERIOD_S, 0))
        if now - since < LOG_PERIOD_S or (kind not in self._logged and len(self._logged) >= MAX_KINDS):
            self._logged[kind] = since, more + 1
            return
        self._logged[kind] = now, 0
        text += f"; {more} more like it before" if more else ""
        if known:
            self._node.get_logger().warning(text)
        else:  # rclpy allows one severity per line of code
            self._node.get_logger().error(text)

    def _publishers_of(self, topic: str) -> str:
        """Who may have sent a message of a topic: DDS hands rclpy's callbacks no sender."""
        ends = self._node.get_publishers_info_by_topic(topic)
        this_node = self._node.get_fully_qualified_name()
        return " or ".join(sorted(nodes_of(ends) - {this_node})) or (this_node if ends else "a publisher that is gone")

    def _bounded(self, publisher: str) -> str:
        if publisher not in self._publishers and len(self._publishers) >= MAX_KINDS:
            return "others"
        self._publishers.add(publisher)
        return publisher


def check_sender(node: Any, topic_name: str, name: str) -> None:
    """Raise WireError where a node speaks of itself on a topic that it does not publish: someone else speaks for it.

    DDS knows an end of a topic before it knows its node's name; while one is unknown, everybody is believed.
    """
    names = nodes_of(node.get_publishers_info_by_topic(topic_name))
    if name not in names and not any(UNKNOWN_NODE in known for known in names):
        raise WireError(ErrorCode.OUT_OF_ORDER, f"it speaks for {name[:80]!r}, which does not publish {topic_name}")


def nodes_of(ends: Iterable[Any]) -> set[str]:
    """The fully qualified names of the nodes that ends of a topic belong to."""
    return {node_of(end) for end in ends}


def node_of(end: Any) -> str:
    """The fully qualified name of the node that an end of a topic belongs to."""
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def _describe(error: Exception, *, where: bool) -> str:
    """One line. where: also the place in the code, of an error that nobody foresaw."""
    text = " ".join(str(error).split())[:MAX_TEXT] or type(error).__name__
    if type(error).__name__ == "RMWError":
        return "its bytes are no message of this type; run the same version of wm_msgs on both sides"
    if not where:
        return text
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {frames[-1].filename.rpartition('/')[2]}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {text}{place}"


def _refuse(response: Any, error: Exception) -> Any:
    """Say in a new response what went wrong, as far as its type can."""
    code = error.code if isinstance(error, WireError) else ErrorCode.INTERNAL
    for field, value in (("error_code", code), ("message", _describe(error, where=False)), ("success", False)):
        if hasattr(response, field):
            setattr(response, field, value)
    return response
