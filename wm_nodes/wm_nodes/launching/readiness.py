"""When is a graph ready: every lifecycle node active, every other node visible. Uses rclpy in a context of its own."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from wm_nodes.launching.graph import NodeSpec

POLL_S = 0.1
ANSWER_S = 2.0
"""A lifecycle node that does not answer get_state within this time is asked again."""
OBSERVER_S = 8.0
"""After this long a new participant looks on. Once, one that had begun to look while a killed node's shared memory lay
there heard nothing of that node's successor for 30 s; 114 further restarts did not show why."""


class NotReadyError(TimeoutError):
    """Nodes are missing or inactive after the deadline; the text names them and their states. nodes: full names."""

    def __init__(self, text: str, nodes: Sequence[str]) -> None:
        super().__init__(text)
        self.nodes = tuple(nodes)


def wait_ready(
    nodes: Sequence[NodeSpec], *, domain: int, timeout_s: float, check: Callable[[], None] = lambda: None
) -> None:
    """Return when all required nodes are ready.

    Args:
        check: called at every poll; raises to give up early, e.g. because a process has ended.

    Raises:
        NotReadyError: after timeout_s.
    """
    deadline = time.monotonic() + timeout_s
    waiting = {node.full_name: node for process in nodes if process.required for node in process.carried()}
    states = dict.fromkeys(waiting, "not seen")
    while waiting:
        with _observer(domain) as (observer, spin_once):
            asked: dict[str, tuple[Any, Any, float]] = {}
            renewal = time.monotonic() + OBSERVER_S
            while waiting and time.monotonic() < renewal:
                check()
                names = {f"{space.rstrip('/')}/{name}" for name, space in observer.get_node_names_and_namespaces()}
                for full_name, node in list(waiting.items()):
                    if full_name in names:
                        states[full_name] = _state(observer, node, asked)
                    if states[full_name] in _ready_states(node):
                        del waiting[full_name]
                if waiting and time.monotonic() > deadline:
                    pending = ", ".join(f"{name} ({states[name]})" for name in waiting)
                    raise NotReadyError(f"not ready after {timeout_s:g} s: {pending}", list(waiting))
                spin_once(POLL_S)


def activate(
    nodes: Sequence[NodeSpec], *, domain: int, timeout_s: float, check: Callable[[], None] = lambda: None
) -> None:
    """Be the lifecycle manager of nodes that were started with autostart false: configure all, then activate all.

    Raises:
        NotReadyError: a node could not configure or activate, or did not answer within timeout_s.
        Whatever `check` raises.
    """
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    managed = [node.full_name for process in nodes for node in process.carried() if node.lifecycle]
    deadline = time.monotonic() + timeout_s
    with _observer(domain) as (observer, spin_once):
        clients = {name: observer.create_client(ChangeState, f"{name}/change_state") for name in managed}
        for transition, number in (
            ("configure", Transition.TRANSITION_CONFIGURE),
            ("activate", Transition.TRANSITION_ACTIVATE),
        ):
            request = ChangeState.Request(transition=Transition(id=number))
            asked: dict[str, Any] = {}
            while len(asked) < len(managed) or not all(future.done() for future in asked.values()):
                check()
                for name, client in clients.items():
                    if name not in asked and client.service_is_ready():
                        asked[name] = client.call_async(request)
                silent = [name for name in managed if name not in asked or not asked[name].done()]
                if silent and time.monotonic() > deadline:
                    text = f"no answer to {transition} within {timeout_s:g} s: {', '.join(silent)}"
                    raise NotReadyError(text, silent)
                spin_once(POLL_S)
            for name, future in asked.items():
                if not future.result().success:
                    raise NotReadyError(f"{name} refused to {transition}", [name])


def _ready_states(node: NodeSpec) -> tuple[str, ...]:
    if not node.lifecycle:
        return ("seen",)
    return ("active",) if node.parameters.get("autostart", True) else ("unconfigured", "inactive", "active")


def _state(observer: Any, node: NodeSpec, asked: dict[str, tuple[Any, Any, float]]) -> str:
    """The lifecycle state of a visible node, as far as it is known."""
    if not node.lifecycle:
        return "seen"
    from lifecycle_msgs.srv import GetState

    client, future, since = asked.get(node.full_name, (None, None, 0.0))
    if client is None:
        client = observer.create_client(GetState, f"{node.full_name}/get_state")
    if future is not None and future.done():
        label = str(future.result().current_state.label)
        asked[node.full_name] = (client, None, 0.0)
        return label
    if client.service_is_ready() and time.monotonic() - since > ANSWER_S:
        asked[node.full_name] = (client, client.call_async(GetState.Request()), time.monotonic())
    else:
        asked.setdefault(node.full_name, (client, future, since))
    return "seen"


@contextmanager
def _observer(domain: int) -> Iterator[tuple[Any, Callable[[float], None]]]:
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    context = Context()
    rclpy.init(args=[], context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(
        f"readiness_{time.monotonic_ns()}", context=context, start_parameter_services=False, enable_rosout=False
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin_once(seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left)

    try:
        yield node, spin_once
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
