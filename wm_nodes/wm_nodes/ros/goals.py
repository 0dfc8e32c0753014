"""Goals of actions, sent from worker threads, each with a deadline."""

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.task import Future

from wm_nodes.ros.clients import POLL_S, Check, wait_event, wait_for, wait_until
from wm_nodes.ros.liveliness import PeerWatch
from wm_nodes.ros.wire import PeerLost

if TYPE_CHECKING:
    from wm_nodes.ros.lifecycle import ManagedNode

LOST_S = 2.0
"""A result that has not arrived so long after the end of its goal is asked for again."""

ENDED = (GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED)


def call_in_executor(node: "ManagedNode", send: Callable[[], Future], timeout_s: float, check: Check) -> Any:
    """Call `send` in the executor's thread and wait for the future it returns."""
    deadline = time.monotonic() + timeout_s
    future = send_in_executor(node, send, timeout_s, check)
    return wait_for(future, max(0.0, deadline - time.monotonic()), check)


def send_in_executor(node: "ManagedNode", send: Callable[[], Future], timeout_s: float, check: Check) -> Future:
    """Call `send` in the executor's thread and return the future it returns.

    rclpy's ActionClient notes a request only after sending it: sent from another thread, the answer may come before the
    note and is then dropped ("Ignoring unexpected goal response").
    """
    sent: list[Future] = []
    ready = threading.Event()

    def run() -> None:
        sent.append(send())
        ready.set()

    node.executor.create_task(run)
    wait_event(ready, timeout_s, check, f"this node's executor did not run for {timeout_s:g} s")
    return sent[0]


def goal_result(handle: Any, timeout_s: float, check: Check) -> Any:
    """Wait in a worker thread for the result of an accepted goal; return the Result message.

    A server that has just started may not have matched this client's reader yet, and then drops its answer for good
    (rmw_fastrtps 556); the goal's status, which is kept for late readers, arrives. So the result is asked for again
    where the goal has ended and its result is not here LOST_S later.

    Raises:
        PeerLost: not here after timeout_s, or the server does not know the goal (any more).
    """
    name, node = handle._action_client._action_name, handle._action_client._node
    deadline = time.monotonic() + timeout_s
    done = threading.Event()
    asked: list[Future] = []

    def ask() -> None:
        asked.append(send_in_executor(node, handle.get_result_async, deadline - time.monotonic(), check))
        asked[-1].add_done_callback(lambda _: done.set())

    ask()
    lost_at = time.monotonic() + LOST_S
    while not done.wait(POLL_S):
        check()
        now = time.monotonic()
        if now >= deadline:
            raise PeerLost(f"{name}: no result within {timeout_s:g} s")
        if handle.status not in ENDED:
            lost_at = now + LOST_S
        elif now >= lost_at:
            node.get_logger().warning(f"{name}: the goal has ended and its result did not arrive; asked again")
            ask()
            lost_at = time.monotonic() + LOST_S
    response = next(future for future in asked if future.done()).result()
    node.executor.create_task(lambda: [future.cancel() for future in asked])
    if response.status == GoalStatus.STATUS_UNKNOWN:
        raise PeerLost(f"{name} does not know the goal it accepted; was its node restarted?")
    return response.result


class _KeptErrors:
    """Calls a callback for the executor, and keeps what it raises for the thread that waits: an exception out of a
    callback ends the process under rclpy's EventsExecutor (SIGSEGV). After one the callback is not called again."""

    def __init__(self, callback: Callable[[Any], object]) -> None:
        self._callback = callback
        self._error: Exception | None = None

    def __call__(self, message: Any) -> None:
        try:
            if self._error is None:
                self._callback(message)
        except Exception as error:  # raised again by check()
            self._error = error

    def check(self) -> None:
        if self._error is not None:
            raise self._error


def run_goal(
    client: ActionClient, goal: Any, *, accept_s: float, check: Check, alive: Check,
    on_feedback: Callable[[Any], object] = lambda message: None,
) -> Any:
    """Send an action goal from a worker thread and wait for its result.

    Args:
        accept_s: deadline for the server to be there and to accept.
        check: raises Cancelled when the caller must stop; the goal is then cancelled too, also one that was sent and is
            accepted only later.
        alive: raises PeerLost when the server is known to be gone.
        on_feedback: called in the executor's thread. What it raises is raised here, and the goal is cancelled.

    Raises:
        PeerLost: no server, no acceptance, a refusal for accept_s, or a lost server.
    """
    name, node = client._action_name, client._node
    wait_until(client.server_is_ready, accept_s, check, name)
    deadline = time.monotonic() + accept_s

    feedback = _KeptErrors(on_feedback)

    def both() -> None:
        check()
        feedback.check()
        alive()

    sent: list[Future] = []

    def send() -> Future:
        sent.append(client.send_goal_async(goal, feedback_callback=feedback))
        return sent[-1]

    while True:
        try:
            handle = call_in_executor(node, send, accept_s, both)
        except BaseException as error:
            node.executor.create_task(lambda: [future.add_done_callback(_cancel_accepted) for future in sent[-1:]])
            if isinstance(error, PeerLost):
                raise PeerLost(f"{name}: {error}") from None
            raise
        if handle.accepted:
            try:
                result = goal_result(handle, float("inf"), both)
                feedback.check()
            except BaseException:
                node.executor.create_task(handle.cancel_goal_async)
                raise
            if result.termination_reason != type(result).REFUSED:
                return result
        if time.monotonic() >= deadline:
            reason = result.message if handle.accepted else "rejected"
            raise PeerLost(f"{name} refused the goal for {accept_s:g} s: {reason}")
        check()
        time.sleep(POLL_S)


def same_process(peers: PeerWatch, name: str) -> Callable[[], None]:
    """Return a check that raises PeerLost once the peer is silent, stopped, or another process than it was here."""
    asked = peers.identity(name)

    def check() -> None:
        nonlocal asked
        asked = asked or peers.identity(name)
        if peers.is_lost(name):
            raise PeerLost(f"{name} is silent")
        if peers.identity(name) != asked:
            raise PeerLost(f"{name} was stopped or restarted")

    return check


def _cancel_accepted(sent: Future) -> None:
    """Cancel a goal that was accepted after its sender had given up; in the executor's thread."""
    handle = sent.result()
    if handle is not None and handle.accepted:
        handle.cancel_goal_async()
