"""Calls from worker threads, each with a deadline; and the environment as a remote or a local one."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.task import Future

from wm_msgs.msg import ErrorCode
from wm_msgs.srv import GetEnvSpec, ResetBatch, StepBatch
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.ros import calls, convert
from wm_nodes.ros.liveliness import PeerWatch
from wm_nodes.ros.wire import PeerLost, Reply, ResetCommand, StepCommand

if TYPE_CHECKING:
    from wm_nodes.ros.lifecycle import ManagedNode

POLL_S = 0.1
"""How often a waiting thread looks whether it must stop."""

ATTEMPT_S = 2.0
"""A step request without an answer is sent again after this time; the environment answers the same step_id once."""

SILENT_S = 8.0
"""An environment that was silent for so long is not asked any more. A crowded machine can keep one quiet for longer
than the time after which it is reported (seen on 2026-11-23 while it drew four simulators), and it answers then."""

BUSY_WAIT_S = 0.005

LOST_S = 2.0
"""A result that has not arrived so long after the end of its goal is asked for again."""

ENDED = (GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED)

Check = Callable[[], None]


def wait_for(future: Future, timeout_s: float, check: Check) -> Any:
    """Wait in a worker thread for a future that the executor completes. Raises PeerLost: not done after timeout_s."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    _wait(done, timeout_s, check, f"no answer within {timeout_s:g} s")
    return future.result()


def _wait(done: threading.Event, timeout_s: float, check: Check, text: str) -> None:
    deadline = time.monotonic() + timeout_s
    while not done.wait(min(POLL_S, max(0.0, deadline - time.monotonic()))):
        check()
        if time.monotonic() >= deadline:
            raise PeerLost(text)


def wait_until(ready: Callable[[], bool], timeout_s: float, check: Check, name: str) -> None:
    """Poll `ready` in a worker thread. Raises PeerLost after timeout_s."""
    deadline = time.monotonic() + timeout_s
    while not ready():
        check()
        if time.monotonic() >= deadline:
            raise PeerLost(f"{name} is not there after {timeout_s:g} s; is its node running and active?")
        time.sleep(POLL_S / 2)


def call(client: Client, request: Any, timeout_s: float, check: Check = lambda: None) -> Any:
    """Call a service from a worker thread. Raises PeerLost after timeout_s without an answer."""
    future = client.call_async(request)
    try:
        return wait_for(future, timeout_s, check)
    except PeerLost as error:
        raise PeerLost(f"{client.srv_name}: {error}") from None
    finally:
        if not future.done():
            client.remove_pending_request(future)


class RosEnvironmentClient:
    """env/step, env/reset and env/get_spec of one environment node.

    Args:
        node: owns the clients until its cleanup.
        prefix: relative namespace of the environment, "" or e.g. "sim".
        timeout_s: deadline of one step or reset, retries and waiting for credit included.
    """

    def __init__(self, node: "ManagedNode", prefix: str = "", timeout_s: float = 10.0) -> None:
        self._node, self._timeout_s = node, timeout_s
        base = f"{prefix}/" if prefix else ""
        self._step = node.create_client(StepBatch, f"{base}env/step")
        self._reset = node.create_client(ResetBatch, f"{base}env/reset")
        self._get_spec = node.create_client(GetEnvSpec, f"{base}env/get_spec")
        for client in (self._step, self._reset, self._get_spec):
            node.own(node.destroy_client, client)
        if prefix:
            node.watch(prefix)
        namespace = node.get_namespace().rstrip("/")
        self._peer = f"{namespace}/{base}environment"
        self._spec: EnvironmentSpec | None = None
        self._session = 0

    @property
    def session(self) -> int:
        return self._session

    def handshake(self, timeout_s: float, check: Check) -> EnvironmentSpec:
        for client in (self._get_spec, self._reset, self._step):
            wait_until(client.service_is_ready, timeout_s, check, client.srv_name)
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                response = call(self._get_spec, GetEnvSpec.Request(), ATTEMPT_S, check)
                if response.error_code == ErrorCode.OK:
                    break
                text = response.message
            except PeerLost as error:
                text = str(error)
            if time.monotonic() >= deadline:
                raise PeerLost(text)
            check()
            time.sleep(POLL_S)
        self._spec = convert.spec_from_msg(response.spec)
        self._session = response.spec.session
        return self._spec

    def reset(self, command: ResetCommand, check: Check) -> Reply:
        # Twice the same reset gives the same observation; a server that has not matched this client's reader yet loses
        # its first answer (rmw_fastrtps 556).
        read = partial(calls.reply_of, spec=self._require_spec())
        reply = self._ask(self._reset, calls.reset_request(command), read, self._timeout_s / 2, check)
        if reply.session != self._session:
            raise PeerLost(f"the environment was restarted (session {reply.session}, not {self.session})")
        return reply

    def step(self, command: StepCommand, check: Check) -> Reply:
        read = partial(calls.reply_of, spec=self._require_spec(), session=self._session)
        try:
            return self._ask(self._step, calls.step_request(command), read, ATTEMPT_S, check)
        except WireError as error:
            if error.code == ErrorCode.SPEC_MISMATCH:
                raise PeerLost(f"the environment was restarted: {error}") from None
            raise

    def _require_spec(self) -> EnvironmentSpec:
        if self._spec is None:
            raise PeerLost("no handshake with the environment yet")
        return self._spec

    def _ask(
        self, client: Client, request: Any, read: Callable[[Any], Reply], attempt_s: float, check: Check
    ) -> Reply:
        """Ask until the environment is not busy, and again where no answer has come after attempt_s."""

        def check_alive() -> None:
            check()
            if self._is_silent:
                raise PeerLost(f"{self._peer} is silent")

        def attempt(left_s: float) -> Reply:
            try:
                response = call(client, request, min(left_s, attempt_s), check_alive)
            except PeerLost:
                if left_s <= attempt_s or self._is_silent:
                    raise
                if client is self._step:
                    self._node.diagnostics.count("step_retries", level=0)
                raise WireError(ErrorCode.BUSY, "sent again") from None
            return read(response)

        try:
            return retry_while_busy(attempt, self._timeout_s, check)
        except WireError as error:
            if error.code == ErrorCode.BUSY:
                raise PeerLost(f"busy for {self._timeout_s:g} s: {error}") from None
            raise

    @property
    def _is_silent(self) -> bool:
        """Whether the environment is lost, and was silent for so long that no answer will come, however often it is
        asked."""
        peers = self._node.peers
        return peers.is_lost(self._peer) and peers.silence_s(self._peer) > SILENT_S


class LocalEnvironmentClient:
    """An environment node in the same process: a direct call instead of the service; topics stay the same.

    Args:
        served: returns the node's lock-step environment, or None while it is not configured.
    """

    def __init__(self, served: Callable[[], Any], timeout_s: float = 10.0) -> None:
        self._get_served, self._timeout_s = served, timeout_s

    @property
    def session(self) -> int:
        return int(self._get_environment().session)

    def handshake(self, timeout_s: float, check: Check) -> EnvironmentSpec:
        wait_until(lambda: self._get_served() is not None, timeout_s, check, "the local environment")
        spec: EnvironmentSpec = self._get_environment().spec
        return spec

    def reset(self, command: ResetCommand, check: Check) -> Reply:
        return retry_while_busy(lambda _: self._get_environment().reset(command), self._timeout_s, check)

    def step(self, command: StepCommand, check: Check) -> Reply:
        return retry_while_busy(lambda _: self._get_environment().step(command), self._timeout_s, check)

    def _get_environment(self) -> Any:
        served = self._get_served()
        if served is None:
            raise PeerLost("the local environment was cleaned up")
        return served


EnvironmentClient = RosEnvironmentClient | LocalEnvironmentClient
"""An environment that is stepped, wherever it lives. handshake() fetches the spec and the session; it is needed at
first and after each PeerLost."""


def retry_while_busy(attempt: Callable[[float], Reply], timeout_s: float, check: Check) -> Reply:
    """Return attempt(seconds left), repeated while it raises WireError(BUSY), which is raised after timeout_s."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return attempt(max(0.0, deadline - time.monotonic()))
        except WireError as error:
            if error.code != ErrorCode.BUSY or time.monotonic() >= deadline:
                raise
        check()
        time.sleep(BUSY_WAIT_S)


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
    _wait(ready, timeout_s, check, f"this node's executor did not run for {timeout_s:g} s")
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


def run_goal(
    client: ActionClient, goal: Any, *, accept_s: float, check: Check, alive: Check, on_feedback: Any = None
) -> Any:
    """Send an action goal from a worker thread and wait for its result.

    Args:
        accept_s: deadline for the server to be there and to accept.
        check: raises Cancelled when the caller must stop; the goal is then cancelled too, also one that was sent and is
            accepted only later.
        alive: raises PeerLost when the server is known to be gone.

    Raises:
        PeerLost: no server, no acceptance, a refusal for accept_s, or a lost server.
    """
    name, node = client._action_name, client._node
    wait_until(client.server_is_ready, accept_s, check, name)
    deadline = time.monotonic() + accept_s

    def both() -> None:
        check()
        alive()

    sent: list[Future] = []

    def send() -> Future:
        sent.append(client.send_goal_async(goal, feedback_callback=on_feedback))
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
