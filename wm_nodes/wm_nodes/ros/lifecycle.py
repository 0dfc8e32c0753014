"""The base of every node: lifecycle, described parameters, diagnostics, heartbeat, sequence numbers, clean stop."""

import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service_introspection import ServiceIntrospectionState

from wm_msgs.msg import ErrorCode, RunState
from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.object_state import with_reader
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.errors import WireError
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.diagnostics import Diagnostics
from wm_nodes.ros.endpoint_matching import Links
from wm_nodes.ros.flow_control import ConsumerCredits
from wm_nodes.ros.guard import Guard
from wm_nodes.ros.liveliness import HEARTBEAT_S, Heartbeat, PeerWatch
from wm_nodes.ros.params import COMMON, Param, declare, refusal
from wm_nodes.ros.publishing import StampedPublisher, destroy_when_heard
from wm_nodes.ros.qos import VIEW, topic
from wm_nodes.ros.sequence_numbers import GapTracker, new_session

T = TypeVar("T")

REFUSALS = (ConfigError, ValueError, OSError, KeyError, ImportError)
"""What a bad setting raises: reported as one line, the node stays where it was. Anything else is a bug: with trace."""

SERVICE_EVENTS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=10)
"""Of the topics <service>/_service_event (REP 2012)."""


class ManagedNode(LifecycleNode):  # type: ignore[misc]
    """A lifecycle node whose subclass says what to do in configure, activate, deactivate and cleanup.

    configure() builds objects, publishers, subscriptions and services; cleanup() lets go of what configure() made
    (entities made through publish_on, listen, serve are destroyed here). The four raise on failure: one of REFUSALS
    leaves the state as it was with one error line, but never holds up cleanup(); anything else goes through error
    processing to `unconfigured`. cleanup() also follows a configure() that failed half-way.
    """

    def __init__(self, name: str, params: Sequence[Param] = (), **node_arguments: Any) -> None:
        self.guard = Guard(self)
        super().__init__(name, **node_arguments)
        for service in self.services:  # of parameters and of the lifecycle
            service.callback = self.guard.wrap_service(service.srv_name, service.callback)
        self.session = new_session()
        """A new one at every configure: what is numbered (seq, step ids) starts again with it."""
        self.failed = False
        """True: the process should end with a non-zero exit code."""
        self._active = False
        self.actions: list[Any] = []
        """The ros.actions.WorkerActions that it serves."""
        self._entities: list[Callable[[], object]] = []
        self._own_publishers: list[Publisher] = []
        self._trackers: dict[str, GapTracker] = {}
        self._introspected: list[Any] = []
        declare(self, (*COMMON, *params))
        self._params = {param.name: param for param in (*COMMON, *params)}
        self.add_post_set_parameters_callback(self._after_set)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        run_dir = self.run_dir if self.param("run_dir") else None
        row = topic("/diagnostics")
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, row.name, row.qos)
        self.diagnostics = Diagnostics(
            self.get_fully_qualified_name(), run_dir.name if run_dir else "", self._publish_diagnostics,
            lambda: self.get_clock().now().to_msg(), run_dir,
        )
        self._heartbeat = Heartbeat(self)
        self.links = Links(self, lambda: self.session, lambda: self._active)
        self._heartbeat_timer = self.create_timer(HEARTBEAT_S, self._on_heartbeat, clock=steady)
        self._diagnostics_timer = self.create_timer(1.0, self._on_diagnostics, clock=steady)

    # What subclasses fill in.

    def configure(self) -> None:
        """Build what the node needs."""

    def activate(self) -> None:
        """Start work."""

    def deactivate(self, reason: str) -> None:
        """Stop work; goals end with this reason."""

    def cleanup(self) -> None:
        """Let go of what configure() built."""

    def on_peer_lost(self, name: str) -> None:
        """A node of the graph has gone silent (fully qualified name)."""

    def update_diagnostics(self) -> None:
        """Set gauges; called once a second."""

    # What subclasses use.

    @property
    def active(self) -> bool:
        return self._active

    @property
    def peers(self) -> PeerWatch:
        """The nodes whose heartbeats this one hears."""
        return self._heartbeat.peers

    def create_subscription(
        self, msg_type: type[Any], topic: str, callback: Callable[[Any], object], qos_profile: Any, *,
        raw: bool = False, **arguments: Any,
    ) -> Any:
        """As rclpy's, but guarded (see ros/guard.py); the callback takes one argument."""
        guarded = self.guard.wrap_subscription(topic, None if raw else msg_type, callback)
        return super().create_subscription(msg_type, topic, guarded, qos_profile, raw=True, **arguments)

    @property
    def run_dir(self) -> Path:
        """Raises ValueError where the parameter is empty."""
        if not self.param("run_dir"):
            raise ValueError(f"{self.get_name()}: parameter run_dir is empty; give the run folder")
        return Path(str(self.param("run_dir")))

    def param(self, name: str) -> Any:
        return self.get_parameter(name).value

    def run_config(self) -> RunConfig:
        """The configuration in `config_file`. Raises ValueError where it is empty, ConfigError where it is wrong."""
        path = str(self.param("config_file"))
        if not path:
            raise ValueError(f"{self.get_name()}: parameter config_file is empty; give the resolved YAML configuration")
        if not Path(path).exists():
            raise ValueError(f"{self.get_name()}: config_file {path!r} does not exist")
        folder = str(self.param("model_dir")) if "model_dir" in self._params else ""
        return with_reader(load_config(path), Path(folder) if folder else None)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """What rclpy calls for `ros2 param set`. A refused change names value and remedy, and is counted."""
        reason = refusal(self, self._params, parameter_list)
        result = SetParametersResult(reason=reason) if reason else super().set_parameters_atomically(parameter_list)
        if not result.successful:
            self.diagnostics.count("refused_parameters", text=f"parameter refused: {result.reason}")
        return result

    def require_active(self) -> None:
        """Raise WireError(NOT_ACTIVE) unless the node is active."""
        if not self._active:
            raise WireError(ErrorCode.NOT_ACTIVE, f"the {self.get_name()} node is not active; activate it first")

    def say_failed_goal(self, text: str) -> None:
        """In the log, and counted in diagnostics."""
        self.get_logger().error(text)
        self.diagnostics.count("failed_goals", level=diagnostics.ERROR, text=text)

    def publish_on(self, name: str, qos: QoSProfile | None = None) -> StampedPublisher:
        """A numbering publisher for a row of the QoS table (or another profile), destroyed at cleanup."""
        publisher = StampedPublisher(self, name, self.session, qos)
        self._own_publishers.append(publisher.publisher)
        return publisher

    def publish_unnumbered(self, name: str) -> Publisher:
        """A publisher for a row of the QoS table whose messages have no (session, seq), destroyed at cleanup."""
        row = topic(name)
        self._own_publishers.append(self.create_publisher(row.type, row.name, row.qos))
        return self._own_publishers[-1]

    def watch(self, prefix: str) -> None:
        """Hear the heartbeats of the nodes of a relative namespace, too, until cleanup: their silence is reported."""
        self.own(self.destroy_subscription, self._heartbeat.watch(f"{prefix}/"))

    def listen(
        self, name: str, callback: Callable[[Any], None], *, credit: bool = False, while_inactive: bool = False
    ) -> ConsumerCredits | None:
        """Subscribe to a row of the QoS table until cleanup. Messages with (session, seq) are checked for gaps.

        credit: grant the producer messages as they are consumed (see flow_control.py), for keep-all streams; the
            ConsumerCredits are returned.
        while_inactive: latched topics, whose message must not be missed before activation.
        """
        row = topic(name)
        credits = ConsumerCredits(self, name) if credit else None
        tracker = self._trackers.setdefault(name, GapTracker())

        def observe(message: Any) -> None:
            if hasattr(message, "seq"):
                self._note_gap(name, tracker, message)
            try:
                if self._active or while_inactive:
                    callback(message)
            finally:
                if credits is not None:
                    credits.record_consumed(tracker)

        subscription = self.create_subscription(row.type, row.name, observe, row.reader_qos)
        self.own(self.destroy_subscription, subscription)
        if credits is not None:
            self.own(credits.close)
        return credits

    def listen_estop(self, callback: Callable[[Any], None]) -> None:
        """Hear safety/estop until cleanup, active or not: what was latched before, and publishers of any QoS, which a
        latched reader does not match. The callback may get a message twice; received and dropped are counted under the
        topic's relative and its absolute name."""
        row, quiet = topic("safety/estop"), SubscriptionEventCallbacks(use_default_callbacks=False)
        for name, qos in ((row.name, row.reader_qos), (self.resolve_topic_name(row.name), VIEW)):
            subscription = self.create_subscription(row.type, name, callback, qos, event_callbacks=quiet)
            self.own(self.destroy_subscription, subscription)

    def serve(
        self, service_type: type[Any], name: str, callback: Callable[[Any, Any], Any], *, counted: str = "",
        code: int = ErrorCode.IO_ERROR,
    ) -> None:
        """A service until cleanup.

        Args:
            counted: a WireError, ValueError or OSError of the callback is the answer, and is counted under this name in
                diagnostics; empty: the callback refuses by itself.
            code: of the answer to a ValueError or OSError, except for a file outside the folders.
        """

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except (WireError, ValueError, OSError) as error:
                if not counted:
                    raise
                refused = convert.refusal_of(error, code)
                self.diagnostics.count(counted, text=f"{name} refused: {refused}")
                return convert.fill_error(service_type.Response(), refused)

        service = self.create_service(service_type, name, self.guard.wrap_service(name, answer))
        self._introspect(service, str(self.param("service_introspection")))
        self._introspected.append(service)
        self.own(self.destroy_service, service)

    def own(self, destroy: Callable[..., object], *arguments: Any) -> None:
        """Call destroy(*arguments) at cleanup."""
        self._entities.append(lambda: destroy(*arguments))

    def on_gap(self, name: str, missing: int) -> None:
        """Sequence numbers of a topic were missed; already counted and logged."""

    # Start and stop, for ros.spin.

    def start(self) -> bool:
        """Configure and activate when `autostart` is set; return False (and set failed) when that fails."""
        if not self.param("autostart"):
            self.get_logger().info("unconfigured; a lifecycle manager configures and activates this node")
            return True
        done = TransitionCallbackReturn.SUCCESS
        self.failed = self.trigger_configure() != done or self.trigger_activate() != done or self.failed
        return not self.failed

    def is_settled(self, stop_s: float) -> bool:
        """Whether all that was sent to this node before the stop, at time.monotonic() `stop_s`, has been taken."""
        return True

    def end_goals(self) -> bool:
        """Answer the goals at work, as the process is about to end; return whether there are any."""
        ended = [action.end("shut down") for action in self.actions]
        return any(ended)

    def stop(self) -> None:
        """Go from any state to finalized; tell the peers that this is no loss."""
        label = self._state_machine.current_state[1]
        if label in ("unconfigured", "inactive", "active"):
            self.trigger_shutdown()
        elif label != "finalized":  # a signal came within a transition
            self.on_shutdown(LifecycleState(label, 0))
        self._heartbeat.end(RunState.FAILED if self.failed else RunState.FINISHED)

    # Lifecycle callbacks of rclpy.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.session = new_session()
        result = self._attempt("configure", self.configure)
        if result == TransitionCallbackReturn.FAILURE:
            self._let_go(self.cleanup)
            self._release()
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._active = True
        result = self._attempt("activate", self.activate)
        if result != TransitionCallbackReturn.SUCCESS:
            self._let_go(lambda: self.deactivate("activation failed"))
            self._active = False
            return result
        self.links.announce()
        self.get_logger().info("active")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._attempt("deactivate", lambda: self.deactivate("deactivated"))
        if result == TransitionCallbackReturn.SUCCESS:
            self._active = False
            self.links.announce()
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        result, done = self._attempt("cleanup", self.cleanup), TransitionCallbackReturn.SUCCESS
        self._release()
        return done if result == TransitionCallbackReturn.FAILURE else result  # nothing is left to clean up

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        if self._active:
            self._attempt("deactivate", lambda: self.deactivate("shut down"))
        self._active = False
        if state.label != "unconfigured":
            self._attempt("cleanup", self.cleanup)
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._active = False
        self.on_cleanup(state)
        return TransitionCallbackReturn.SUCCESS

    def _attempt(self, action: str, work: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            work()
        except REFUSALS as error:
            return self._refuse(action, error, TransitionCallbackReturn.FAILURE)
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            return self._refuse(action, error, TransitionCallbackReturn.ERROR)
        self.diagnostics.clear_condition("lifecycle")
        return TransitionCallbackReturn.SUCCESS

    def _refuse(self, action: str, error: Exception, result: TransitionCallbackReturn) -> TransitionCallbackReturn:
        text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
        self.get_logger().error(f"{action} failed: {text or type(error).__name__}")
        self.diagnostics.set_condition("lifecycle", diagnostics.ERROR, f"{action} failed: {text}")
        return result

    def _let_go(self, work: Callable[[], None]) -> None:
        """What follows a failure, whose reason stays in diagnostics; a further error is logged."""
        try:
            work()
        except Exception:
            self.get_logger().error(f"another error after that: {traceback.format_exc()}")

    def _release(self) -> None:
        self._introspected.clear()
        while self._entities:
            self._entities.pop()()
        destroy_when_heard(self, self._own_publishers)
        self._trackers.clear()

    # Heartbeat and diagnostics.

    def _note_gap(self, name: str, tracker: GapTracker, message: Any) -> None:
        jumps = tracker.jumps
        missing = tracker.observe(message.session, message.seq)
        if tracker.jumps > jumps:
            self.diagnostics.count(f"jumps {name}", text=f"{name} jumped to seq {message.seq}; a second sender?")
        if missing:
            self.diagnostics.count(f"gaps {name}", missing, text=f"{missing} messages of {name} missed")
            self.on_gap(name, missing)

    def _on_heartbeat(self) -> None:
        for name in self._heartbeat.beat():
            self.links.table.forget(name, lost=True)
            self.on_peer_lost(name)
        self.links.announce()

    def _after_set(self, changes: Sequence[Parameter]) -> None:
        for change in changes:
            if change.name == "service_introspection":
                for service in self._introspected:
                    self._introspect(service, change.value)

    def _introspect(self, service: Any, state: str) -> None:
        """Publish a service's events: none (off), who and when (metadata), or everything (contents)."""
        chosen = getattr(ServiceIntrospectionState, state.upper())
        service.configure_introspection(self.get_clock(), SERVICE_EVENTS, chosen)

    def _on_diagnostics(self) -> None:
        self.links.announce(again=True)
        self.update_diagnostics()
        self.diagnostics.gauge("state", self._state_machine.current_state[1])
        for name, number in self.guard.handled.items():
            self.diagnostics.gauge(f"received {name}", number)
        for name, tracker in self._trackers.items():
            if tracker.received:
                self.diagnostics.gauge(f"lost {name}", tracker.lost)
        self.diagnostics.publish()

    def _publish_diagnostics(self, message: DiagnosticArray) -> None:
        with suppress(InvalidHandle):
            self._diagnostics_publisher.publish(message)

