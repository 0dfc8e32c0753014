"""Actions whose work runs in a thread: cancel is answered at once, and nothing is awaited.

An execute callback that awaits keeps a core busy under EventsExecutor (measured: 2.06 s of CPU for a 2 s wait), and a
blocking one cannot be cancelled. Here the executor only accepts, cancels and sends results.
"""

import threading
import traceback
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

from wm_nodes.ros.wire import Cancelled
from wm_nodes.ros.worker import Work, WorkerNode


class _ThreadedServer(ActionServer):  # type: ignore[misc]
    """Starts the work when rclpy would run the execute callback, and hands rclpy a finished one afterwards."""

    begin: Callable[[ServerGoalHandle], None]

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        self.begin(goal_handle)

    def finish(self, goal_handle: ServerGoalHandle, conclude: Callable[[ServerGoalHandle], Any]) -> None:
        super().notify_execute(goal_handle, conclude)


class WorkerAction:
    """One action, one goal at a time, until the node's cleanup.

    Args:
        node: goals are refused while it is not active.
        action_type: e.g. wm_msgs.action.Train.
        name: relative action name.
        run: does the work in its own thread and returns a Result; raises Cancelled when told to stop.
        fill: completes the Result of a goal that ended early; it has termination_reason (one of the Result's constants
            CANCELED, DEACTIVATED, FAILED) and message.
    """

    def __init__(
        self, node: WorkerNode, action_type: type[Any], name: str, run: Callable[[Work], Any],
        fill: Callable[[Any], Any] = lambda result: result,
    ) -> None:
        self._node, self._type, self._name, self._run, self._fill = node, action_type, name, run, fill
        self._lock = threading.Lock()
        self._work: Work | None = None
        self._thread: threading.Thread | None = None
        self._server = _ThreadedServer(
            node, action_type, name, execute_callback=lambda goal: None, goal_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )
        self._server.begin = self._begin
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

    def destroy(self) -> None:
        self.stop("deactivated")
        self._server.destroy()

    def _on_goal(self, request: Any) -> GoalResponse:
        logger = self._node.get_logger()
        if not self._node.active:
            logger.error(f"{self._name} goal refused: the node is not active; activate it first")
            return GoalResponse.REJECT
        with self._lock:
            if self._work is not None:
                logger.warning(f"{self._name} goal refused: another goal is running; cancel it or wait")
                return GoalResponse.REJECT
            self._work = Work(request, lambda feedback: None, threading.Event())
        return GoalResponse.ACCEPT

    def _on_cancel(self, goal_handle: ServerGoalHandle) -> CancelResponse:
        work = self._work
        if work is None:
            return CancelResponse.REJECT
        work.stop("cancelled")
        return CancelResponse.ACCEPT

    def _begin(self, goal_handle: ServerGoalHandle) -> None:
        work = self._work
        assert work is not None
        work.request = goal_handle.request
        work.feedback = goal_handle.publish_feedback
        self._thread = threading.Thread(target=self._thread_main, args=(goal_handle, work), name=self._name)
        self._thread.start()

    def _end_early(self, reason: int, text: str) -> Any:
        return self._fill(self._type.Result(termination_reason=reason, message=text))

    def _thread_main(self, goal_handle: ServerGoalHandle, work: Work) -> None:
        reasons = self._type.Result
        try:
            result, state = self._run(work), "succeed"
            if result.termination_reason not in (reasons.FINISHED, getattr(reasons, "LIMIT", reasons.FINISHED)):
                state = "abort"
        except Cancelled as stop:
            cancelled = str(stop) == "cancelled"
            code = reasons.CANCELED if cancelled else reasons.DEACTIVATED
            result, state = self._end_early(code, str(stop)), "canceled" if cancelled else "abort"
        except Exception as error:
            self._node.get_logger().error(traceback.format_exc())
            text = f"{type(error).__name__}: {error}"
            self._node.say_failed_goal(f"{self._name} failed: {text}")
            result, state = self._end_early(reasons.FAILED, text), "abort"

        def conclude(handle: ServerGoalHandle) -> Any:
            if state == "canceled" and not handle.is_cancel_requested:
                handle.abort()
            elif state == "succeed" and handle.is_cancel_requested:
                handle.succeed()
            else:
                getattr(handle, state)()
            return result

        self._work = None
        self._server.finish(goal_handle, conclude)
