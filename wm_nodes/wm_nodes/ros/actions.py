"""Actions whose work runs in a thread: cancel is answered at once, and nothing is awaited.

ROS 2 gives no reason for a rejected goal. So every goal is accepted, and one that cannot be done now ends at once,
aborted, with termination_reason REFUSED and a message that its client prints.

An execute callback that awaits keeps a core busy under EventsExecutor (measured: 2.06 s of CPU for a 2 s wait), and a
blocking one cannot be cancelled. Here the executor only accepts, cancels and sends results.
"""

import threading
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

from wm_nodes.core.errors import WireError
from wm_nodes.ros.guard import LOG_PERIOD_S
from wm_nodes.ros.wire import Cancelled, PeerLost
from wm_nodes.ros.worker import Work

if TYPE_CHECKING:
    from wm_nodes.ros.lifecycle import ManagedNode

RESULTS_KEPT_S = 120
"""How long the result of an ended goal can be asked for."""
ABANDON_S = 3.0
"""A goal whose work has not ended so long after its node was told to end is answered all the same; the starter kills a
node after 10 s."""

REFUSALS = (WireError, ValueError, OSError, FloatingPointError)
"""What a bad request or a bad file raises: answered in one line, without a trace."""


class _Guarded:
    """Drops an answer, a request or a feedback that makes no sense, so that the node lives on."""

    _node: Any
    _action_name: str

    def take_data(self) -> Any:
        try:
            return super().take_data()  # type: ignore[misc]
        except Exception as error:
            self._node.guard.drop(self._action_name, error)
            return {}

    async def execute(self, taken_data: Any) -> None:
        try:
            await super().execute(taken_data)  # type: ignore[misc]
        except Exception as error:
            self._node.guard.drop(self._action_name, error)


class GuardedActionClient(_Guarded, ActionClient):  # type: ignore[misc]
    """A client of an action, in a ManagedNode."""


class _ThreadedServer(_Guarded, ActionServer):  # type: ignore[misc]
    """Starts the work when rclpy would run the execute callback, and hands rclpy a finished one afterwards."""

    begin: Callable[[ServerGoalHandle], None]

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        self.begin(goal_handle)

    def finish(self, goal_handle: ServerGoalHandle, conclude: Callable[[ServerGoalHandle], Any]) -> None:
        super().notify_execute(goal_handle, conclude)


class WorkerAction:
    """One action, one goal at a time, until the node's cleanup.

    Args:
        node: a ManagedNode; goals are refused while it is not active.
        action_type: e.g. wm_msgs.action.Train.
        name: relative action name.
        run: does the work in its own thread and fills a Result, whose termination_reason is FINISHED at first; raises
            Cancelled when told to stop. PeerLost ends the goal with PEER_LOST (FAILED where the Result has none), one
            of REFUSALS with FAILED and its text; both are said and counted.
        fill: completes the Result of every goal, also of one that ended early.
    """

    def __init__(
        self, node: "ManagedNode", action_type: type[Any], name: str, run: Callable[[Work, Any], None],
        fill: Callable[[Any], Any] = lambda result: result,
    ) -> None:
        self._node, self._type, self._name, self._run, self._fill = node, action_type, name, run, fill
        self._lock = threading.Lock()
        self._work: Work | None = None
        self._goal_id = b""
        self._goal_handle: Any = None
        self._thread: threading.Thread | None = None
        self._ending = ""
        self._server = _ThreadedServer(
            node, action_type, name, execute_callback=lambda goal: None,
            goal_callback=lambda request: GoalResponse.ACCEPT, cancel_callback=self._on_cancel,
            result_timeout=RESULTS_KEPT_S,
        )
        self._server.begin = self._begin
        node.actions.append(self)
        node.own(self.destroy)

    @property
    def busy(self) -> bool:
        return self._work is not None

    def stop(self, reason: str, wait_s: float = 5.0) -> None:
        """End the running goal with a reason; wait for its thread."""
        work, thread = self._work, self._thread
        if work is not None:
            work.stop(reason)
        if thread is not None and thread is not threading.current_thread():
            thread.join(wait_s)

    def end(self, reason: str) -> bool:
        """Answer the running goal, as the process is about to end; return whether there was one. The answer leaves when
        the executor spins again."""
        with self._lock:
            self._ending, goal_handle, work = reason, self._goal_handle, self._work
        self.stop(reason, ABANDON_S)
        if work is None:
            return False
        self._thread = None
        self._conclude(goal_handle, work, self._end_early(self._type.Result.DEACTIVATED, reason), "abort")
        return True

    def destroy(self) -> None:
        self.stop("deactivated")
        self._node.actions.remove(self)
        self._server.destroy()

    def _on_cancel(self, goal_handle: ServerGoalHandle) -> CancelResponse:
        work = self._work
        if work is None or bytes(goal_handle.goal_id.uuid) != self._goal_id:
            return CancelResponse.REJECT
        work.stop("cancelled")
        return CancelResponse.ACCEPT

    def _begin(self, goal_handle: ServerGoalHandle) -> None:
        with self._lock:
            if refusal := self._refusal():
                self._refuse(goal_handle, refusal)
                return
            work = Work(goal_handle.request, goal_handle.publish_feedback, threading.Event())
            self._work, self._goal_handle = work, goal_handle
            self._goal_id = bytes(goal_handle.goal_id.uuid)
        self._thread = threading.Thread(target=self._thread_main, args=(goal_handle, work), name=self._name)
        self._thread.start()

    def _refusal(self) -> str:
        if self._ending:
            return f"the node is {self._ending}"
        if not self._node.active:
            return "the node is not active; activate it first"
        return "another goal is running; cancel it or wait" if self._work is not None else ""

    def _refuse(self, goal_handle: ServerGoalHandle, reason: str) -> None:
        result = self._end_early(self._type.Result.REFUSED, f"refused: {reason}")
        self._node.get_logger().warning(f"{self._name} goal refused: {reason}", throttle_duration_sec=LOG_PERIOD_S)
        self._node.diagnostics.count("refused_goals", text=f"{self._name} goal refused: {reason}")

        def conclude(handle: ServerGoalHandle) -> Any:
            handle.abort()
            return result

        self._server.finish(goal_handle, conclude)

    def _end_early(self, reason: int, text: str) -> Any:
        return self._fill(self._type.Result(termination_reason=reason, message=text))

    def _thread_main(self, goal_handle: ServerGoalHandle, work: Work) -> None:
        reasons = self._type.Result
        result, cancelled = reasons(termination_reason=reasons.FINISHED), False
        try:
            self._run(work, result)
        except Cancelled as stop:
            cancelled = str(stop) == "cancelled"
            code = reasons.CANCELED if cancelled else reasons.DEACTIVATED
            result = reasons(termination_reason=code, message=str(stop))
        except PeerLost as error:
            self._fail(result, f"a peer is lost: {error}", getattr(reasons, "PEER_LOST", reasons.FAILED))
        except REFUSALS as error:
            self._fail(result, str(error), reasons.FAILED)
        except Exception as error:
            self._node.get_logger().error(traceback.format_exc())
            text = f"{type(error).__name__}: {error}"
            if isinstance(error, MemoryError) or "allocate memory" in text:
                text += "; a larger memory_limit_gib allows more"
            self._fail(result, text, reasons.FAILED)
        done = (reasons.FINISHED, getattr(reasons, "LIMIT", reasons.FINISHED))
        state = "canceled" if cancelled else "succeed" if result.termination_reason in done else "abort"
        self._conclude(goal_handle, work, self._fill(result), state)

    def _fail(self, result: Any, text: str, reason: int) -> None:
        result.termination_reason, result.message = reason, text
        self._node.say_failed_goal(f"{self._name} failed: {text}")

    def _conclude(self, goal_handle: ServerGoalHandle, work: Work, result: Any, state: str) -> None:
        """Answer a goal, once."""
        with self._lock:
            if self._work is not work:
                return
            self._work = None

        def conclude(handle: ServerGoalHandle) -> Any:
            if state == "canceled" and not handle.is_cancel_requested:
                handle.abort()
            elif state == "succeed" and handle.is_cancel_requested:
                handle.succeed()
            else:
                getattr(handle, state)()
            return result

        self._server.finish(goal_handle, conclude)
