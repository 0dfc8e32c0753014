"""environment: serves one batch of environments, in lock-step or on its own clock, and publishes what happens in it.

The environment runs in the executor's thread: a step delays this node's other callbacks by its own duration, nothing
else. In a composed process a local policy steps it from its worker thread instead.
"""

import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer
from sensor_msgs.msg import Image
from std_msgs.msg import Bool

from wm_msgs.msg import ActionBatch, EpisodeEvent, ErrorCode
from wm_msgs.srv import GetEnvSpec, ResetBatch, StepBatch
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals, LockStep
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import UInt8Array
from wm_nodes.nodes.environment.asynchronous import AsynchronousEnvironment
from wm_nodes.nodes.environment.camera_topics import CameraTopics
from wm_nodes.nodes.environment.image_views import PARAMS as VIEW_PARAMS
from wm_nodes.nodes.environment.image_views import ImageViews
from wm_nodes.nodes.environment.lockstep import LockstepEnvironment
from wm_nodes.nodes.environment.stamp_clock import StampClock
from wm_nodes.nodes.factories import BACKENDS, make_environment
from wm_nodes.recording.messages import tiles_of
from wm_nodes.ros import calls, convert, diagnostics
from wm_nodes.ros.flow_control import ProducerCredits
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.wire import EpisodeNote

MODES = ("lockstep", "asynchronous")

MAX_MOSAIC_BYTES = 96 * 2**20
"""Largest env/image that was tried: it arrives, in about a second. Writer and readers keep up to 32 of them."""

HOLD_AFTER_S = 1.0
"""A robot in lock-step that within an episode was told nothing more for so long holds: its client may have died."""

PARAMS = (
    Param("backend", "world_model", "What is stepped: a model, or by the configuration environment.factory, or "
          "evaluation.environment", read_only=True, choices=BACKENDS),
    Param("model_dir", "", "World-model folder, for backend world_model", read_only=True),
    Param("video_model_dir", "", "Folder of a video model that is stepped, for backend video_model", read_only=True),
    Param("starts_file", "", "starts.safetensors: real first frames, for an imagining backend", read_only=True),
    Param("num_envs", 1, "Environments stepped together (N)", read_only=True, minimum=1, maximum=4096),
    Param("seed", 0, "Root seed of resets without a given seed", read_only=True, minimum=0),
    Param("mode", "lockstep", "Stepped by requests on env/step, or by the node's clock with the newest of `action`",
          read_only=True, choices=MODES),
    Param("control_period_s", 0.0, "Time between two steps in mode asynchronous; 0: that of the environment", "s",
          read_only=True, minimum=0.0, maximum=60.0),
    Param("max_action_age_s", 0.3, "Mode asynchronous: an action is used until the observation it answers is older "
          "than this; then the environment holds", "s", minimum=0.001, maximum=60.0),
    *VIEW_PARAMS,
)


class EnvironmentNode(ManagedNode):
    """Services env/step, env/reset, env/get_spec; topics env/image, env/transition, env/spec, env/goal, episode.

    In mode asynchronous it follows `action`; in lock-step a robot obeys its MODE_HOLD, by which a rollout ends.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("environment", PARAMS, **node_arguments)
        self.served: LockstepEnvironment | None = None
        self._stamps = StampClock(lambda: self.get_clock().now().nanoseconds)
        self._estop = False
        self._timer: Timer | None = None
        self._unsent = deque[Callable[[], object]]()
        self._sending = threading.Lock()
        self._answering = False

    def configure(self) -> None:
        environment = make_environment(
            str(self.param("backend")), self.run_config(), num_envs=int(self.param("num_envs")),
            seed=int(self.param("seed")), model_dir=str(self.param("model_dir")),
            starts_file=str(self.param("starts_file")), video_model_dir=str(self.param("video_model_dir")),
        )
        if (size := mosaic_bytes(environment.spec)) > MAX_MOSAIC_BYTES:
            environment.close()
            raise ValueError(
                f"num_envs={environment.spec.num_envs} images of {environment.spec.height} x {environment.spec.width} "
                f"px make one env/image of {size} bytes, more than the {MAX_MOSAIC_BYTES} that DDS carries in time; "
                "lower num_envs or simulation.image_size"
            )
        self.served = LockstepEnvironment(
            environment, self.session, self, seed=int(self.param("seed")), clock=self._stamps
        )
        self.served.before_step, self.served.estop = self._require_credit, self._estop
        self._spec = environment.spec
        self._shown: Image | None = None
        self._images = self.publish_unnumbered("env/image")
        self._views = ImageViews(self)
        self._cameras = CameraTopics(self, environment)
        self._transitions = self.publish_on("env/transition")
        self._episodes = self.publish_on("episode")
        self._goals = self.publish_on("env/goal")
        self._credits = ProducerCredits("env/transition", self.session)
        self.listen("flow/credit", self._credits.note)
        self.listen_estop(self._on_estop)
        self.serve(StepBatch, "env/step", self._on_step)
        self.serve(ResetBatch, "env/reset", self._on_reset)
        self.serve(GetEnvSpec, "env/get_spec", self._on_get_spec)
        self.publish_on("env/spec").publish(convert.spec_msg(self._spec, self.get_clock().now().nanoseconds))
        self._asynchronous: AsynchronousEnvironment | None = None
        if self.param("mode") == "asynchronous":
            self._asynchronous = AsynchronousEnvironment(self.served, lambda: float(self.param("max_action_age_s")))
        if self._asynchronous is not None or self.served.is_robot:
            self.listen("action", self._on_action)

    def activate(self) -> None:
        if self._asynchronous is None:
            if self._ready().is_robot:
                steady = Clock(clock_type=ClockType.STEADY_TIME)
                self._timer = self.create_timer(HOLD_AFTER_S / 4, self._on_watch, clock=steady)
            return
        self._period_s = float(self.param("control_period_s")) or self._spec.control_period_s
        if (max_age_s := float(self.param("max_action_age_s"))) <= self._period_s:
            raise ValueError(
                f"max_action_age_s {max_age_s:g} is not above the control period of {self._period_s:g} s: every action "
                "would be too old in the next step; raise max_action_age_s, or lower control_period_s"
            )
        try:
            self._asynchronous.start()
        except WireError as error:
            raise ValueError(f"the first reset failed: {error}") from None
        self._timer = self.create_timer(self._period_s, self._on_tick)

    def deactivate(self, reason: str) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        self._send_rest()
        if self.served is not None:
            self._hold()
            self.served.end_episodes(EpisodeEvent.REASON_DEACTIVATED)

    def cleanup(self) -> None:
        served, self.served = self.served, None
        if served is not None:
            served.close()

    def on_peer_lost(self, name: str) -> None:
        if self.served is not None:
            self._credits.remove(name)

    def update_diagnostics(self) -> None:
        if self.served is not None:
            self.diagnostics.gauge("step_id", self.served.next_step_id - 1)
            self.diagnostics.gauge("credit_consumers", ", ".join(self._credits.consumers) or "none")

    # Sink of the lock-step environment.

    def image(self, images: UInt8Array, stamp_ns: int) -> None:
        message = convert.mosaic_msg(images, stamp_ns, self._spec)
        message.header.frame_id = self._cameras.mosaic_frame_id
        self._shown = message
        self._send(lambda: self._images.publish(message))
        self._send(lambda: self._show(images, message))

    def _show(self, images: UInt8Array, message: Image) -> None:
        self._views.show(images, message)
        self._cameras.show(images, message)

    def goals(self, goals: Goals) -> None:
        self._send(lambda: self._goals.publish(convert.goal_msg(goals, self._spec)))

    def transition(self, transition: LockStep) -> None:
        self._send(lambda: self._transitions.publish(convert.transition_msg(transition)))

    def episode(self, note: EpisodeNote) -> None:
        self._send(lambda: self._episodes.publish(convert.episode_msg(note, self._spec)))

    def _send(self, publish: Callable[[], object]) -> None:
        """Publish: now, or after the answer where a step is being answered, while the client works with it."""
        self._unsent.append(publish)
        if not self._answering:
            self._send_rest()

    def _send_rest(self) -> None:
        with self._sending:
            while self._unsent:
                self._unsent.popleft()()

    # Callbacks.

    def _on_step(self, request: StepBatch.Request, response: StepBatch.Response) -> StepBatch.Response:
        self._send_rest()
        self._answering = True
        try:
            return self._answer_step(request, response)
        finally:
            self._answering = False
            self.executor.create_task(self._send_rest)

    def _answer_step(self, request: StepBatch.Request, response: StepBatch.Response) -> StepBatch.Response:
        try:
            served = self._ready()
            if self._asynchronous is not None:
                raise WireError(
                    ErrorCode.OUT_OF_ORDER,
                    "this environment steps by its own clock; publish on `action`, or start it with mode:=lockstep",
                )
            reply = served.step(calls.step_command(request, self._spec))
        except WireError as error:
            return self._refusal(response, error, "step")
        self.diagnostics.latency("step", reply.step_s)
        return calls.fill_response(response, reply, self._spec, self._shown)

    def _on_reset(self, request: ResetBatch.Request, response: ResetBatch.Response) -> ResetBatch.Response:
        try:
            served = self._ready()
            command = calls.reset_command(request, self._spec)
            reply = served.reset(command) if self._asynchronous is None else self._asynchronous.reset(command)
        except WireError as error:
            return self._refusal(response, error, "reset")
        return calls.fill_response(response, reply, self._spec, self._shown)

    def _on_get_spec(self, request: GetEnvSpec.Request, response: GetEnvSpec.Response) -> GetEnvSpec.Response:
        try:
            self.require_active()
        except WireError as error:
            return convert.fill_error(response, error)
        response.spec = convert.spec_msg(self._spec, self.get_clock().now().nanoseconds)
        response.spec.session = self.session
        return response

    def _on_action(self, message: ActionBatch) -> None:
        if self._asynchronous is None:
            if message.mode == ActionBatch.MODE_HOLD:
                self._hold()
            return
        if message.mode == ActionBatch.MODE_HOLD:
            self._asynchronous.hold()
            return
        try:
            self._asynchronous.offer(convert.action_of(message, self._spec))
        except WireError as error:
            self._count_refusal(error, "action")

    def _on_tick(self) -> None:
        assert self._asynchronous is not None
        began = time.perf_counter()
        try:
            if not self._asynchronous.tick():
                self.diagnostics.count("action_timeouts", text="no fresh action; the environment holds")
        except WireError as error:
            if error.code == ErrorCode.BUSY:
                self.diagnostics.count("steps_left_out", text=f"a step was left out, and a robot holds: {error}")
            elif error.code != ErrorCode.ESTOP:
                self._count_refusal(error, "step")
            return
        spent = time.perf_counter() - began
        self.diagnostics.latency("step", spent)
        if spent > self._period_s:
            self.diagnostics.count("overruns", text=f"a step took {spent:.3f} s, the control period is less")

    def _on_watch(self) -> None:
        """Have a robot hold, once, where no client goes on with its episode."""
        if self._ready().left_for_s > HOLD_AFTER_S:
            self._hold()
            text = f"no step came for {HOLD_AFTER_S:g} s within an episode; the robot holds"
            self.get_logger().warning(text)
            self.diagnostics.count("idle_holds", text=text)

    def _on_estop(self, message: Bool) -> None:
        if self.served is None or message.data == self._estop:
            return
        self._estop = self.served.estop = bool(message.data)
        self.diagnostics.show_estop(self._estop)
        self.get_logger().warning(f"emergency stop {'set' if message.data else 'released'}")
        if not message.data:
            return
        if self.active:
            self._hold()
        self.served.end_episodes(EpisodeEvent.REASON_ESTOP)

    def _hold(self) -> None:
        """Have a robot hold, as no further step may come; a simulator, too, where it has a clock of its own."""
        assert self.served is not None
        try:
            if self._asynchronous is not None:
                self._asynchronous.stop()
            elif self.served.is_robot:
                self.served.hold_now()
        except WireError as error:
            self._count_refusal(error, "hold")

    def _ready(self) -> LockstepEnvironment:
        self.require_active()
        assert self.served is not None  # while it is active
        return self.served

    def _require_credit(self) -> None:
        self.require_active()
        next_seq = self._transitions.next_seq
        blocking = self._credits.blocking_consumers(next_seq)
        if not blocking:
            return
        for name in self._credits.drop_silent(next_seq):
            self.diagnostics.count("dropped_consumers", text=f"{name} gave no credit for 5 s; not waited for")
            blocking.remove(name)
        if blocking:
            self.diagnostics.count("waits_for_credit", level=diagnostics.OK)
            raise WireError(ErrorCode.BUSY, f"waiting for {', '.join(blocking)} to take in seq {next_seq - 1}; retry")

    def _refusal(self, response: Any, error: WireError, kind: str) -> Any:
        self._count_refusal(error, kind)
        return convert.fill_error(response, error)

    def _count_refusal(self, error: WireError, kind: str) -> None:
        if error.code != ErrorCode.BUSY:
            bad_numbers = error.code in (ErrorCode.NAN_INPUT, ErrorCode.NAN_MODEL)
            level = diagnostics.ERROR if bad_numbers or error.code == ErrorCode.INTERNAL else diagnostics.WARN
            self.diagnostics.count(f"refused_{kind}", level=level, text=f"{kind} refused: {error}")
            if bad_numbers:
                self.diagnostics.count("nan", level=level, text=str(error))
            trace = "".join(traceback.format_exception(error.__cause__)) if error.__cause__ is not None else ""
            self.get_logger().error(f"{kind} refused: {error}\n{trace}".rstrip(), throttle_duration_sec=1.0)


def mosaic_bytes(spec: EnvironmentSpec) -> int:
    """Bytes of one env/image: all environments' tiles, empty ones included."""
    height, width = tiles_of(spec).mosaic_shape
    return height * width * spec.channels


def main() -> int:
    return run_node(EnvironmentNode)


if __name__ == "__main__":
    sys.exit(main())
