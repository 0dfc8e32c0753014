"""The guard with a node that only counts and logs; over DDS it is tested in tests/graph."""

from array import array
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from wm_msgs.msg import ErrorCode, NodeLinks
from wm_msgs.srv import StepBatch
from wm_nodes.core.errors import WireError
from wm_nodes.ros import guard as guard_module
from wm_nodes.ros.guard import Guard


class CountingNode:
    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.texts: list[str] = []
        self.log: list[str] = []
        self.diagnostics = SimpleNamespace(count=self._count)
        self.publishers = [SimpleNamespace(node_namespace="/wm", node_name="a")]

    def _count(self, key: str, number: int = 1, *, level: int = 1, text: str = "") -> None:
        self.counts[key] = self.counts.get(key, 0) + number
        self.texts += [text] if text else []

    def get_logger(self) -> Any:
        return SimpleNamespace(**{kind: lambda text, kind=kind: self.log.append(f"{kind} {text}")
                                  for kind in ("warning", "error")})

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return self.publishers

    def get_fully_qualified_name(self) -> str:
        return "/wm/me"


LINKS = serialize_message(NodeLinks(node="x", linked=["a"], linked_sessions=array("Q", [3])))
UNREADABLE = (b"", b"\x00\x01\x00\x00", LINKS[:20], LINKS[:-8], b"\xff" * 40)


def test_a_message_is_read_and_what_cannot_be_read_is_counted_by_topic_and_publisher() -> None:
    node, got = CountingNode(), list[NodeLinks]()
    guard = Guard(node)
    receive = guard.wrap_subscription("run/links", NodeLinks, got.append)
    for data in (LINKS, *UNREADABLE, LINKS):
        receive(data)
    assert [message.node for message in got] == ["x", "x"]
    assert node.counts == {"dropped run/links": 5, "dropped run/links by /wm/a": 5} and guard.handled["run/links"] == 2
    assert node.log == [
        "warning run/links dropped: its bytes are no message of this type; run the same version of wm_msgs on both "
        "sides; from /wm/a"
    ]


def test_one_kind_is_logged_once_a_minute_with_the_number_of_those_between(monkeypatch: pytest.MonkeyPatch) -> None:
    node, now = CountingNode(), [0.0]
    monkeypatch.setattr(guard_module.time, "monotonic", lambda: now[0])
    guard = Guard(node)

    def refuse(message: NodeLinks) -> None:
        raise WireError(ErrorCode.BAD_SHAPE, f"at {now[0]:g}")

    receive = guard.wrap_subscription("run/links", NodeLinks, refuse)
    for now[0] in (0.0, 1.0, 59.0):
        receive(LINKS)
    receive(b"")  # another kind
    now[0] = 61.0
    receive(LINKS)
    assert [line.split("; ")[0] for line in node.log] == [
        "warning run/links dropped: at 0", "warning run/links dropped: its bytes are no message of this type",
        "warning run/links dropped: at 61",
    ]
    assert node.log[-1].endswith("2 more like it before")


def test_an_error_that_nobody_foresaw_is_an_error_with_its_place() -> None:
    node = CountingNode()
    node.publishers.append(SimpleNamespace(node_namespace="/", node_name="b"))

    def fail(message: NodeLinks) -> None:
        raise KeyError("shape")

    Guard(node).wrap_subscription("run/links", NodeLinks, fail)(LINKS)
    assert node.log[0].startswith("error run/links dropped: KeyError: 'shape' at test_guard.py:")
    assert node.log[0].endswith("from /b or /wm/a")


@pytest.mark.parametrize("kind", [StepBatch, Trigger])
def test_a_request_that_makes_a_service_fail_is_answered_with_the_reason(kind: type[Any]) -> None:
    def fail(request: Any, response: Any) -> Any:
        if kind is StepBatch:
            response.step_id = 7
        raise OverflowError("too large")

    node = CountingNode()
    answer = Guard(node).wrap_service("env/step", fail)(kind.Request(), kind.Response())
    assert answer.message == "too large" and node.counts == {"dropped env/step": 1}
    assert (answer.error_code, answer.step_id) == (ErrorCode.INTERNAL, 0) if kind is StepBatch else not answer.success


def test_the_number_of_counters_has_a_limit() -> None:
    node = CountingNode()
    receive = Guard(node).wrap_subscription("run/links", NodeLinks, lambda message: None)
    for number in range(guard_module.MAX_KINDS + 50):
        node.publishers = [SimpleNamespace(node_namespace="/", node_name=f"p{number}")]
        receive(b"")
    assert len(node.counts) <= guard_module.MAX_KINDS + 2
    assert node.counts["dropped run/links by others"] == 50
