"""Service calls from worker threads, each with a deadline; and the environment as a remote or a local one."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.client import Client
from rclpy.task import Future

from wm_msgs.msg import ErrorCode
from wm_msgs.srv import GetEnvSpec, ResetBatch, StepBatch
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.ros import calls, convert
from wm_nodes.ros.wire import PeerLost, Reply, ResetCommand, StepCommand

if TYPE_CHECKING:
    from wm_nodes.ros.lifecycle import ManagedNode

POLL_S = 0.1
"""How often a waiting thread looks whether it must stop."""

ATTEMPT_S = 2.0
"""A step request without an answer is sent again after this time; the environment makes the same step_id once."""

SENT_AGAIN_S = 1.0
"""Longest wait for the answers to a request that was sent again and is answered already."""

SILENT_S = 8.0
"""An environment that was silent for so long is not asked any more. A crowded machine can keep one quiet for longer
than the time after which it is reported (seen on 2026-11-23 while it drew four simulators), and it answers then."""

BUSY_WAIT_S = 0.005

Check = Callable[[], None]


def wait_for(future: Future, timeout_s: float, check: Check) -> Any:
    """Wait in a worker thread for a future that the executor completes. Raises PeerLost: not done after timeout_s."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    wait_event(done, timeout_s, check, f"no answer within {timeout_s:g} s")
    return future.result()


def wait_event(done: threading.Event, timeout_s: float, check: Check, text: str) -> None:
    """Wait in a worker thread. Raises PeerLost(text) after timeout_s."""
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


class RepeatedCall:
    """A service call that may be sent several times; whichever answer comes first counts. For a worker thread."""

    def __init__(self, client: Client, request: Any) -> None:
        self._client, self._request = client, request
        self._waiting: list[Future] = []

    def ask(self, timeout_s: float, check: Check) -> Any:
        """Send the request, once more where it was sent before. Raises PeerLost after timeout_s without an answer; one
        that comes later is the answer to the next ask()."""
        answered = threading.Event()
        self._waiting.append(self._client.call_async(self._request))
        for future in self._waiting:
            future.add_done_callback(lambda _: answered.set())
        wait_event(answered, timeout_s, check, f"{self._client.srv_name}: no answer within {timeout_s:g} s")
        first = next(future for future in self._waiting if future.done())
        self._forget(self._waiting.index(first) + 1)
        return first.result()

    def await_rest(self) -> None:
        """Wait for the answers to what was sent after the answered one, SENT_AGAIN_S at most: the server then takes
        none of it after what is sent next."""
        deadline = time.monotonic() + SENT_AGAIN_S
        while any(not future.done() for future in self._waiting) and time.monotonic() < deadline:
            time.sleep(BUSY_WAIT_S)

    def end(self) -> None:
        """Wait for no answer any more."""
        self._forget(len(self._waiting))

    def _forget(self, count: int) -> None:
        for future in self._waiting[:count]:
            if not future.done():
                self._client.remove_pending_request(future)
        self._waiting = self._waiting[count:]


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
        # Sent again at half the time: a server that has not matched this client's reader yet loses its first answer
        # (rmw_fastrtps 556). Where it was slow instead, the environment answers the repeat as it did the first.
        read = partial(calls.reply_of, spec=self._require_spec())
        reply = self._ask(self._reset, calls.reset_request(command), read, self._timeout_s / 2, check)
        if reply.session != self._session:
            raise PeerLost(f"the environment was restarted (session {reply.session}, not {self.session})")
        return reply

    def step(self, command: StepCommand, check: Check) -> Reply:
        read = partial(calls.reply_of, spec=self._require_spec(), session=self._session)
        return self._ask(self._step, calls.step_request(command), read, ATTEMPT_S, check)

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
                response = repeated.ask(min(left_s, attempt_s), check_alive)
            except PeerLost:
                if left_s <= attempt_s or self._is_silent:
                    raise
                if client is self._step:
                    self._node.diagnostics.count("step_retries", level=0)
                raise WireError(ErrorCode.BUSY, "sent again") from None
            return read(response)

        repeated = RepeatedCall(client, request)
        try:
            reply = retry_while_busy(attempt, self._timeout_s, check)
            if client is self._reset:
                repeated.await_rest()
            return reply
        finally:
            repeated.end()

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
    """Return attempt(seconds left), repeated while it raises WireError(BUSY).

    Raises:
        PeerLost: the environment is BUSY for timeout_s, NOT_ACTIVE, or another than before (SPEC_MISMATCH): it may come
            back.
        WireError: any other refusal.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return attempt(max(0.0, deadline - time.monotonic()))
        except WireError as error:
            if error.code in (ErrorCode.NOT_ACTIVE, ErrorCode.SPEC_MISMATCH):
                raise PeerLost(f"the environment was stopped or restarted: {error}") from None
            if error.code != ErrorCode.BUSY:
                raise
            if time.monotonic() >= deadline:
                raise PeerLost(f"busy for {timeout_s:g} s: {error}") from None
        check()
        time.sleep(BUSY_WAIT_S)
