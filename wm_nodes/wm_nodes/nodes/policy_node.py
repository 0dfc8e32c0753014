"""policy: acts in the environment, for a number of lock-steps (action rollout) or on what it sees (mode asynchronous),
and follows the learner's versions."""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from std_msgs.msg import Bool

from wm_msgs.action import Rollout
from wm_msgs.msg import ActionBatch, EnvSpec, ErrorCode, PolicyVersion
from wm_msgs.srv import InferAction, LoadPolicy
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.types import UInt64Array
from wm_nodes.nodes.factories import expected_spec, make_policy, refuse_for_policy
from wm_nodes.nodes.policy.asynchronous import AsynchronousPolicy
from wm_nodes.nodes.policy.weights import PolicyHolder, load_initial, read_weights
from wm_nodes.policy_rl.image_policy import PolicyOutput
from wm_nodes.policy_rl.rollouts import action_noise, reset_seeds
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.messages import floats, images_of
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.actions import WorkerAction
from wm_nodes.ros.clients import EnvironmentClient, LocalEnvironmentClient, RosEnvironmentClient
from wm_nodes.ros.endpoint_matching import StartBarrier
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param, named_files
from wm_nodes.ros.qos import LIVE_ACTION
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.wire import Reply, ResetCommand, StepCommand
from wm_nodes.ros.worker import Work

FEEDBACK_S = 0.5

PARAMS = (
    Param("model_dir", "", "World-model folder; its tokenizer is the policy's encoder", read_only=True),
    Param("initial_policy", "", "Weights (safetensors) to act with before the learner announces any", read_only=True),
    Param("step_timeout_s", 10.0, "Deadline of one env/step or env/reset, retries included", "s", read_only=True,
          minimum=0.1, maximum=600.0),
    Param("handshake_timeout_s", 10.0, "Deadline for the environment to answer env/get_spec", "s",
          minimum=0.1, maximum=600.0),
    Param("version_timeout_s", 10.0, "Deadline for the policy version that a goal asks for to arrive", "s",
          minimum=0.1, maximum=600.0),
    Param("mode", "lockstep", "Act in rollouts, by env/step, or on every observation that comes, by `action`",
          read_only=True, choices=("lockstep", "asynchronous")),
    Param("deterministic", True, "Mode asynchronous: act without noise"),
    Param("await_nodes", ["environment"], "Nodes of the namespace that must be active, and matched with all others, "
          "before a rollout begins; whoever else is active is waited for too", read_only=True),
    Param("match_timeout_s", 20.0, "Deadline for that; then the rollout goes on, and is reported as incomplete", "s",
          minimum=0.0, maximum=600.0),
)


class PolicyNode(ManagedNode):
    """Action rollout; services policy/infer, policy/load; follows policy/version; publishes action.

    Args:
        local_environment: in a composed process, returns the environment node's lock-step environment; it is then
            called directly instead of through env/step.
    """

    def __init__(self, local_environment: Callable[[], Any] | None = None, **node_arguments: Any) -> None:
        super().__init__("policy", PARAMS, **node_arguments)
        self._local_environment = local_environment
        self._estop = False

    def configure(self) -> None:
        given = self.run_config(), str(self.param("model_dir"))
        policy = make_policy(*given)
        load_initial(policy, str(self.param("initial_policy")))
        self._holder, self._expected_spec = PolicyHolder(policy), expected_spec(*given)
        self._envs_per_start = given[0].ppo.envs_per_start
        self._files = named_files(self, str(self.param("initial_policy")))
        self._spec: EnvironmentSpec | None = None
        self._refusal: WireError | None = None
        self._announced: PolicyVersion | None = None
        self._last_reply: Reply | None = None
        self._start_barrier = StartBarrier(self, self.links.table)
        timeout_s = float(self.param("step_timeout_s"))
        self._environment: EnvironmentClient = (
            RosEnvironmentClient(self, timeout_s=timeout_s) if self._local_environment is None
            else LocalEnvironmentClient(self._local_environment, timeout_s)
        )
        self._asynchronous: AsynchronousPolicy | None = None
        if self.param("mode") == "asynchronous":
            self._asynchronous = AsynchronousPolicy(
                self, self._holder, self._publish_actions, self._publish_hold, stopped=self._estop
            )
        self._actions = self.publish_on("action", LIVE_ACTION if self._asynchronous else None)
        self.listen_estop(self._on_estop)
        self.listen("env/spec", self._on_spec, while_inactive=True)
        self.listen("policy/version", self._on_version, while_inactive=True)
        self.serve(InferAction, "policy/infer", self._on_infer, counted="refused_infer", code=ErrorCode.BAD_SHAPE)
        self.serve(LoadPolicy, "policy/load", self._on_load, counted="refused_loads")
        self._rollouts = WorkerAction(self, Rollout, "rollout", self._rollout)

    def activate(self) -> None:
        if self._asynchronous is not None:
            self._asynchronous.start()

    def deactivate(self, reason: str) -> None:
        self._rollouts.stop(reason)
        if self._asynchronous is not None:
            self._asynchronous.stop()
            self._publish_hold()

    def update_diagnostics(self) -> None:
        if hasattr(self, "_holder"):
            self.diagnostics.gauge("policy_version", self._holder.version)
            if self._asynchronous is not None:
                self.diagnostics.gauge("skipped_observations", self._asynchronous.skipped)

    # The rollout, in a worker thread.

    def _rollout(self, work: Work, result: Rollout.Result) -> None:
        try:
            self._act(work, result)
        except Exception:
            self._last_reply = None
            raise
        finally:
            if self._asynchronous is None and self._spec is not None and self._spec.source == SOURCE_REAL:
                self._publish_hold()  # no further step comes

    def _act(self, work: Work, result: Rollout.Result) -> None:
        goal: Rollout.Goal = work.request
        if self._asynchronous is not None:
            raise ValueError("in mode asynchronous the policy acts on what it sees; start it with mode:=lockstep")
        if goal.steps < 1:
            raise ValueError(f"steps must be at least 1, got {goal.steps}")
        spec = self._environment.handshake(float(self.param("handshake_timeout_s")), work.check)
        self._check_spec(spec)
        self._await_version(goal.policy_version, work)
        self._start_barrier.wait(work)
        version = self._holder.version
        reply = self._first_observation(goal, spec, version, work)
        result.policy_version, result.env_session = version, reply.session
        result.first_step_id = reply.step_id + 1
        ended = reply.ended
        started = reported = time.monotonic()
        for step in range(goal.steps):
            work.check()
            assert reply.images is not None
            noise = None
            if not goal.deterministic:
                noise = action_noise(goal.seed, version, step, spec.num_envs, spec.action_dim)
            began = time.perf_counter()
            output, acting = self._holder.act(reply.images, reply.states, noise)
            infer_s = time.perf_counter() - began
            if goal.policy_version and acting != goal.policy_version:
                raise WireError(
                    ErrorCode.STALE_POLICY, f"version {acting} was loaded while {goal.policy_version} had to act"
                )
            step_id = reply.step_id + 1
            self._publish_actions(reply.stamp_ns, step_id, output, acting, infer_s)
            began, before = time.perf_counter(), reply
            reply = self._environment.step(
                StepCommand(
                    session=reply.session, step_id=step_id, spec_hash=spec.spec_hash,
                    actions=output.actions.reshape(-1), policy_version=acting, logprobs=output.logprobs,
                    values=output.values, reset_mask=ended if ended.any() else None,
                    reset_seeds=self._reset_seeds(goal, version, step, spec) if ended.any() else None,
                ),
                work.check,
            )
            reply.check_follows(before, ended)
            self.diagnostics.latency("infer", infer_s)
            self.diagnostics.latency("step", time.perf_counter() - began)
            self._last_reply = reply
            ended = reply.ended
            result.last_step_id = step_id
            result.episodes += int(ended.sum())
            result.successes += int(reply.success.sum())
            now = time.monotonic()
            result.steps_per_s = (step + 1) * spec.num_envs / max(now - started, 1e-9)
            if now - reported > FEEDBACK_S:
                reported = now
                work.feedback(Rollout.Feedback(step=step + 1, steps_per_s=result.steps_per_s))

    def _first_observation(self, goal: Rollout.Goal, spec: EnvironmentSpec, version: int, work: Work) -> Reply:
        last = self._last_reply
        if not goal.reset and last is not None and last.session == self._environment.session:
            return last
        seeds = self._reset_seeds(goal, version, 0, spec)
        return self._environment.reset(ResetCommand(seeds=seeds, behaviour=goal.behaviour), work.check)

    def _reset_seeds(self, goal: Rollout.Goal, version: int, step: int, spec: EnvironmentSpec) -> UInt64Array:
        return reset_seeds(goal.seed, version, step, spec.num_envs, self._envs_per_start)

    def _check_spec(self, spec: EnvironmentSpec) -> None:
        refuse_for_policy(spec, self._expected_spec, self._holder.policy)
        self._spec = spec

    def _await_version(self, version: int, work: Work) -> None:
        deadline = time.monotonic() + float(self.param("version_timeout_s"))
        announced = self._announced
        if announced is not None and announced.version == version != self._holder.version:
            self._holder.follow(announced, self._files)  # policy/load has replaced it since
        while version and self._holder.version != version:
            if time.monotonic() > deadline:
                raise WireError(
                    ErrorCode.STALE_POLICY,
                    f"version {version} did not arrive, {self._holder.version} is loaded; is the learner running?",
                )
            work.sleep(0.01)

    def _publish_actions(self, stamp_ns: int, step_id: int, output: PolicyOutput, version: int, infer_s: float) -> None:
        message = self._action_message(output, version, infer_s)
        message.header = convert.header(stamp_ns)
        message.step_id = step_id
        self._actions.publish(message)

    def _publish_hold(self) -> None:
        self._actions.publish(ActionBatch(mode=ActionBatch.MODE_HOLD))

    @staticmethod
    def _action_message(output: PolicyOutput, version: int, infer_s: float) -> ActionBatch:
        count, action_dim = output.actions.shape
        message = ActionBatch(
            num_envs=count, action_dim=action_dim, chunk_length=1, policy_version=version, infer_ms=infer_s * 1e3,
            mode=ActionBatch.MODE_POLICY,
        )
        message.action = convert.to_field(output.actions)
        message.log_prob = convert.to_field(output.logprobs)
        message.value = convert.to_field(output.values)
        return message

    # Callbacks.

    def _on_estop(self, message: Bool) -> None:
        """In mode lockstep the environment's refusal ends the rollout."""
        if message.data == self._estop:
            return
        self._estop = bool(message.data)
        if self._asynchronous is not None:
            self._asynchronous.obey_stop(self._estop)
        self.diagnostics.show_estop(self._estop)
        self.get_logger().warning(f"emergency stop {'set' if message.data else 'released'}")

    def _on_spec(self, message: EnvSpec) -> None:
        """A refused spec leaves the one before, as anybody may send one; what its sender shows is not acted on."""
        spec: EnvironmentSpec | None = None
        try:
            spec = convert.spec_from_msg(message)
            self._check_spec(spec)
            self._refusal = None
        except WireError as error:
            if self._asynchronous is not None and spec is not None:
                self._asynchronous.refused_session = message.session
            self._refusal = error
            self.get_logger().error(f"env/spec refused: {error}")
            self.diagnostics.count("refused_specs", level=diagnostics.ERROR, text=str(error))
        if self._asynchronous is not None:
            self._asynchronous.spec = self._spec

    def _on_version(self, message: PolicyVersion) -> None:
        try:
            if self._holder.follow(message, self._files):
                self.diagnostics.clear_condition("policy version")
            self._announced = message
        except (WireError, ValueError) as error:
            text = f"{error}; still acting with version {self._holder.version}"
            self.get_logger().error(text, throttle_duration_sec=1.0)
            self.diagnostics.count("refused_versions", level=diagnostics.OK)
            self.diagnostics.set_condition("policy version", diagnostics.ERROR, str(error))

    def _on_infer(self, request: InferAction.Request, response: InferAction.Response) -> InferAction.Response:
        self.require_active()
        if self._spec is None:
            raise self._refusal or WireError(
                ErrorCode.NOT_ACTIVE, "no env/spec seen yet; start an environment or replay a bag"
            )
        count = len(request.state) // self._holder.policy.state_dim
        spec = replace(self._spec, num_envs=max(count, 1))
        states = floats(request.state, (spec.num_envs, spec.state_dim), "state")
        if not np.isfinite(states).all():
            raise WireError(ErrorCode.NAN_INPUT, "state is NaN or infinite; send finite values")
        tile = request.tile
        if (tile.tile_height, tile.tile_width) != (spec.height, spec.width) or tile.rows * tile.cols < count:
            raise WireError(
                ErrorCode.BAD_SHAPE,
                f"{tile.rows} x {tile.cols} tiles of {tile.tile_height} x {tile.tile_width} px do not hold {count} "
                f"of {spec.height} x {spec.width} px; lay them out as EnvSpec.tile does",
            )
        tiles = Tiles(tile.rows, tile.cols, tile.tile_height, tile.tile_width)
        images = images_of(request.observation, spec, tiles)
        noise = None if request.deterministic else np.random.default_rng().standard_normal(
            (spec.num_envs, spec.action_dim), np.float32
        )
        began = time.perf_counter()
        output, version = self._holder.act(images, states, noise)
        response.action = self._action_message(output, version, time.perf_counter() - began)
        response.action.header.stamp = request.observation.header.stamp
        return response

    def _on_load(self, request: LoadPolicy.Request, response: LoadPolicy.Response) -> LoadPolicy.Response:
        if self._rollouts.busy:
            raise WireError(ErrorCode.BUSY, "a rollout is running; cancel it or wait")
        self._holder.load(read_weights(request.uri, self._files), 0, request.sha256)
        response.version = self._holder.version
        return response


def main() -> int:
    return run_node(PolicyNode)


if __name__ == "__main__":
    sys.exit(main())
