"""environment: serves one batch of environments in lock-step, and publishes what happens in it.

The environment runs in the executor's thread: a step delays this node's other callbacks by its own duration, nothing
else. In a composed process a local policy steps it from its worker thread instead.
"""

import sys
from typing import Any

import numpy as np
from sensor_msgs.msg import Image
from std_msgs.msg import Bool

from wm_msgs.msg import Credit, EpisodeEvent, ErrorCode
from wm_msgs.srv import GetEnvSpec, ResetBatch, StepBatch
from wm_nodes.nodes.backends import BACKENDS, make_environment
from wm_nodes.nodes.lockstep import LockstepEnvironment
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.credit import CreditLedger
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.qos import VIEW, topic
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.wire import EpisodeNote, Goals, Transition, WireError
from wm_nodes.types import UInt8Array

PARAMS = (
    Param("backend", "world_model", "What is stepped", read_only=True, choices=BACKENDS),
    Param("backend_factory", "", "module:callable(config, num_envs, seed) -> Environment, for backend factory; the "
          "plug-in point for real robots", read_only=True),
    Param("model_dir", "", "World-model folder, for backend world_model", read_only=True),
    Param("starts_file", "", "starts.safetensors: real first frames, for backend world_model", read_only=True),
    Param("num_envs", 1, "Environments stepped together (N)", read_only=True, minimum=1, maximum=4096),
    Param("seed", 0, "Root seed of resets without a given seed", read_only=True, minimum=0),
    Param("view_env", -1, "Also publish this environment's image alone on env/image/view while someone looks; -1: none",
          minimum=-1, maximum=4095),
    Param("view_period_s", 0.066, "Least time between two env/image/view", "s", minimum=0.0, maximum=10.0),
)  # fmt: skip


class EnvironmentNode(ManagedNode):
    """Services env/step, env/reset, env/get_spec; topics env/image, env/transition, env/spec, env/goal, episode."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("environment", PARAMS, **node_arguments)
        self.served: LockstepEnvironment | None = None

    def configure(self) -> None:
        environment = make_environment(
            str(self.param("backend")), self.run_config(), num_envs=int(self.param("num_envs")),
            seed=int(self.param("seed")), model_dir=str(self.param("model_dir")),
            starts_file=str(self.param("starts_file")), factory=str(self.param("backend_factory")),
        )  # fmt: skip
        self.served = LockstepEnvironment(environment, self.session, self)
        self.served.before_step = self._require_credit
        self._spec = environment.spec
        row = topic("env/image")
        self._images = self.create_publisher(Image, row.name, row.qos)
        self._view = self.create_publisher(Image, "env/image/view", VIEW)
        self._last_view_s = 0.0
        for publisher in (self._images, self._view):
            self.own(self.destroy_publisher, publisher)
        self._transitions = self.publish_on("env/transition")
        self._episodes = self.publish_on("episode")
        self._goals = self.publish_on("env/goal")
        self._ledger = CreditLedger("env/transition", self.session)
        self.listen("flow/credit", self._on_credit)
        self.listen("safety/estop", self._on_estop)
        self.serve(StepBatch, "env/step", self._on_step)
        self.serve(ResetBatch, "env/reset", self._on_reset)
        self.serve(GetEnvSpec, "env/get_spec", self._on_get_spec)
        self.publish_on("env/spec").publish(convert.spec_msg(self._spec, self.get_clock().now().nanoseconds))

    def deactivate(self, reason: str) -> None:
        if self.served is not None:
            self.served.end_episodes(EpisodeEvent.REASON_DEACTIVATED)

    def cleanup(self) -> None:
        if self.served is not None:
            self.served.close()
            self.served = None

    def on_peer_lost(self, name: str) -> None:
        if self.served is not None:
            self._ledger.remove(name)

    def update_diagnostics(self) -> None:
        if self.served is not None:
            self.diagnostics.gauge("step_id", self.served.next_step_id - 1)
            self.diagnostics.gauge("credit_consumers", ", ".join(sorted(self._ledger.consumers)) or "none")

    # Sink of the lock-step environment.

    def image(self, images: UInt8Array, stamp_ns: int) -> None:
        self._images.publish(convert.mosaic_msg(images, stamp_ns, self._spec))
        shown = int(self.param("view_env"))
        now_s = self.get_clock().now().nanoseconds / 1e9
        if 0 <= shown < len(images) and now_s - self._last_view_s >= float(self.param("view_period_s")):
            self._last_view_s = now_s
            if self._view.get_subscription_count():
                self._view.publish(convert.image_msg(images[shown], stamp_ns, self._spec.encoding))

    def goals(self, goals: Goals) -> None:
        self._goals.publish(convert.goal_msg(goals, self._spec))

    def transition(self, transition: Transition) -> None:
        self._transitions.publish(convert.transition_msg(transition))
        if not np.isfinite(transition.next_states).all():
            self.diagnostics.count("nan_model", level=diagnostics.ERROR, text="the model produced NaN")

    def episode(self, note: EpisodeNote) -> None:
        self._episodes.publish(convert.episode_msg(note, self._spec))

    # Callbacks.

    def _on_step(self, request: StepBatch.Request, response: StepBatch.Response) -> StepBatch.Response:
        try:
            served = self._ready()
            reply = served.step(convert.step_command(request, self._spec))
        except WireError as error:
            return self._refusal(response, error, "step")
        self.diagnostics.latency("step", reply.step_s)
        return convert.fill_step_response(response, reply, self._spec)

    def _on_reset(self, request: ResetBatch.Request, response: ResetBatch.Response) -> ResetBatch.Response:
        try:
            served = self._ready()
            reply = served.reset(convert.reset_command(request, self._spec))
        except WireError as error:
            return self._refusal(response, error, "reset")
        return convert.fill_reset_response(response, reply, self._spec)

    def _on_get_spec(self, request: GetEnvSpec.Request, response: GetEnvSpec.Response) -> GetEnvSpec.Response:
        if not self.active:
            return convert.fill_error(response, self._not_active())
        response.spec = convert.spec_msg(self._spec, self.get_clock().now().nanoseconds)
        response.spec.session = self.session
        return response

    def _on_credit(self, message: Credit) -> None:
        self._ledger.note(message)

    def _on_estop(self, message: Bool) -> None:
        if self.served is None or message.data == self.served.estop:
            return
        self.served.estop = bool(message.data)
        if message.data:
            self.served.end_episodes(EpisodeEvent.REASON_ESTOP)
            self.diagnostics.set_condition("estop", diagnostics.ERROR, "the emergency stop is set")
        else:
            self.diagnostics.clear_condition("estop")
        self.get_logger().warning(f"emergency stop {'set' if message.data else 'released'}")

    def _ready(self) -> LockstepEnvironment:
        if not self.active or self.served is None:
            raise self._not_active()
        return self.served

    def _not_active(self) -> WireError:
        return WireError(ErrorCode.NOT_ACTIVE, "the environment node is not active; activate it first")

    def _require_credit(self) -> None:
        if not self.active:
            raise self._not_active()
        next_seq = self._transitions.next_seq
        holding = self._ledger.holding(next_seq)
        if not holding:
            return
        for name in self._ledger.drop_silent(next_seq):
            self.diagnostics.count("dropped_consumers", text=f"{name} gave no credit for 5 s; not waited for")
            holding.remove(name)
        if holding:
            self.diagnostics.count("waits_for_credit", level=diagnostics.OK)
            raise WireError(ErrorCode.BUSY, f"waiting for {', '.join(holding)} to take in seq {next_seq - 1}; retry")

    def _refusal(self, response: Any, error: WireError, what: str) -> Any:
        if error.code != ErrorCode.BUSY:
            bad_numbers = error.code in (ErrorCode.NAN_INPUT, ErrorCode.NAN_MODEL)
            level = diagnostics.ERROR if bad_numbers else diagnostics.WARN
            self.diagnostics.count(f"refused_{what}", level=level, text=f"{what} refused: {error}")
            if bad_numbers:
                self.diagnostics.count("nan", level=level, text=str(error))
            self.get_logger().error(f"{what} refused: {error}", throttle_duration_sec=1.0)
        return convert.fill_error(response, error)


def main() -> int:
    return run_node(EnvironmentNode)


if __name__ == "__main__":
    sys.exit(main())
