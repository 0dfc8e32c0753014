"""reward_evaluator: judges every transition, after joining it with its two images by exact stamp and with its goals;
with the reward agent, every episode at its end."""

import sys
import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Image

from wm_msgs.msg import EnvSpec, ErrorCode, RewardSummary, TaskGoal, TransitionBatch
from wm_msgs.srv import EvaluateReward
from wm_nodes.config.schema import AGENT
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.judge.episode_reward import EpisodeReward, PendingReward, episode_judge
from wm_nodes.nodes.factories import REWARDS, make_reward
from wm_nodes.nodes.judge import services
from wm_nodes.nodes.judge.services import JudgeServices
from wm_nodes.nodes.reward.summary import SummaryWindow
from wm_nodes.policy_rl.rollouts import reward_input
from wm_nodes.recording.join import Joiner
from wm_nodes.recording.messages import goals_of, images_of, time_ns
from wm_nodes.reward import RewardModel, RewardResult
from wm_nodes.reward.base import SUCCESS_UNKNOWN
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.sequence_numbers import check_session
from wm_nodes.ros.spin import run_node

PARAMS = (
    Param("reward", "endogenous", "Reward model", read_only=True, choices=REWARDS),
    Param("model_dir", "", "World-model folder, for the endogenous reward's distance", read_only=True),
    Param("image_wait_s", 1.0, "A transition waits for its images and goals at most so long", "s",
          minimum=0.0, maximum=60.0),
    Param("summary_period_s", 1.0, "Time between two reward/summary", "s", read_only=True, minimum=0.1, maximum=60.0),
    *services.PARAMS,
)


class RewardEvaluatorNode(ManagedNode):
    """Listens to env/spec, env/image, env/transition, env/goal; publishes reward, reward/summary; with the agent also
    what JudgeServices has."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("reward_evaluator", PARAMS, **node_arguments)
        self._agent: JudgeServices | None = None

    def configure(self) -> None:
        config, kind = self.run_config(), str(self.param("reward"))
        self._agent = None
        self._undecided: deque[tuple[float, LockStep, PendingReward]] = deque()
        self._model: RewardModel | EpisodeReward
        if kind == AGENT and not config.reward.factory:
            agent = JudgeServices(self, episode_judge(config), config, lambda: bool(self._undecided))
            self._model = EpisodeReward(agent.judge)
            self._agent = agent
        else:
            self._model = make_reward(kind, config, str(self.param("model_dir")))
        self._spec: EnvironmentSpec | None = None
        self._session = self._spec_session = 0
        self._joiner = Joiner(with_goals=True)
        self._window = SummaryWindow()
        self._rewards = self.publish_on("reward")
        self._summaries = self.publish_on("reward/summary")
        self.listen("env/spec", self._on_spec, while_inactive=True)
        self.listen("env/image", self._on_image)
        self.listen("env/goal", self._on_goal, while_inactive=True)
        self.listen("env/transition", self._on_transition, credit=True)
        self.serve(EvaluateReward, "reward/evaluate", self._on_evaluate, counted="refused_evaluations")
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timers = (
            self.create_timer(0.1, self._on_timer, clock=steady),
            self.create_timer(float(self.param("summary_period_s")), self._publish_summary, clock=steady),
        )
        for timer in timers:
            self.own(self.destroy_timer, timer)

    def deactivate(self, reason: str) -> None:
        self._drop_undecided()
        if self._agent is not None:
            self._agent.stop(reason)

    def update_diagnostics(self) -> None:
        if self._agent is not None:
            self._agent.update_diagnostics()
            self.diagnostics.gauge("undecided_steps", len(self._undecided))
            if isinstance(self._model, EpisodeReward):
                self.diagnostics.gauge("cut_episodes", self._model.cut)

    def on_gap(self, name: str, missing: int) -> None:
        self._window.invalid += missing if name == "env/transition" else 0

    # Topics.

    def _on_spec(self, message: EnvSpec) -> None:
        try:
            check_session(message.session)
            spec = convert.spec_from_msg(message)
            known = spec.spec_hash if self._spec is None else self._spec.spec_hash
            if known != spec.spec_hash and message.session == self._spec_session:
                raise WireError(
                    ErrorCode.SPEC_MISMATCH,
                    f"session {message.session} announces another env/spec than before; is a second publisher there?",
                )
        except WireError as error:
            self.diagnostics.count("refused_specs", level=diagnostics.ERROR, text=str(error))
            return
        if known != spec.spec_hash:
            self._session = 0  # what was read by the spec before is of no use, either
        self._spec, self._spec_session = spec, message.session
        self._enter_session(message.session)

    def _enter_session(self, session: int) -> None:
        """What came from the environment process before is of no use."""
        if session != self._session:
            self._session = session
            self._joiner.clear()
            self._drop_undecided()
            self._window.forget_episodes()

    def _on_image(self, message: Image) -> None:
        if self._spec is not None:
            self._joiner.put_image(time_ns(message.header.stamp), images_of(message, self._spec))
            self._judge_joined()

    def _on_goal(self, message: TaskGoal) -> None:
        if self._spec is not None:
            check_session(message.session, self._session)
            goals = goals_of(message, self._spec)
            self._enter_session(message.session)
            self._joiner.put_goals(goals)
            self._judge_joined()

    def _on_transition(self, message: TransitionBatch) -> None:
        if self._spec is None:
            self.diagnostics.count("before_spec", text="a transition came before env/spec; it gets no reward")
            return
        check_session(message.session, self._session)
        step = convert.transition_of(message, self._spec)
        self._enter_session(message.session)
        if not step.is_reset and step.valid.any():
            self._joiner.put_step(step)
            self._judge_joined()

    def _judge_joined(self) -> None:
        """Judge, in order, the lock-steps whose images and goals are there or are overdue."""
        for step in self._joiner.take(patience_s=float(self.param("image_wait_s"))):
            if isinstance(self._model, EpisodeReward):
                self._undecided.append((time.perf_counter(), step, self._collect(self._model, step)))
                self._publish_decided()
            else:
                began = time.perf_counter()
                result = self._judge(step)
                self._publish(step, result, time.perf_counter() - began)

    # Whole episodes, judged while the graph goes on; rewards leave in the order of their steps.

    def _on_timer(self) -> None:
        self._judge_joined()
        self._publish_decided()

    def _collect(self, model: EpisodeReward, step: LockStep) -> PendingReward:
        """Add the step to its episodes; where that fails, it has no rewards."""
        assert self._spec is not None  # transitions wait for it
        try:
            return model.add(step, self._spec)
        except Exception as error:
            return PendingReward(step.valid, {int(n): _text(error) for n in np.flatnonzero(step.valid)})

    def _publish_decided(self) -> None:
        while self._agent is not None and self._undecided and self._undecided[0][2].done:
            since, step, pending = self._undecided.popleft()
            for env, verdict in pending.verdicts().items():
                self._agent.publish(verdict, clip=env, iteration=step.step_id, stamp_ns=step.stamp_ns)
            for env, problem in pending.problems().items():
                text = f"step {step.step_id} of environment {env} has no verdict: {problem}"
                self.get_logger().error(text, throttle_duration_sec=1.0)
            self._publish(step, pending.result(), time.perf_counter() - since)

    def _drop_undecided(self) -> None:
        """Forget what is being judged and what has not ended: it belongs to nobody any more."""
        for _, _, pending in self._undecided:
            pending.cancel()
        self._undecided.clear()
        if isinstance(self._model, EpisodeReward):
            self._model.forget()

    def _judge(self, step: LockStep) -> RewardResult:
        model = self._model
        if isinstance(model, EpisodeReward):
            return _unjudged(step, "the reward agent judges whole episodes, not single steps")
        if step.images is None or step.next_images is None:
            missing = step.stamp_ns if step.images is None else step.next_stamp_ns
            return _unjudged(step, f"no image with stamp {missing} ns")
        try:
            result = model.evaluate(reward_input(step.images, step.next_images, step, step.goals))
            _check_rewards(result, len(step.valid))
            return result
        except Exception as error:  # of a reward model that may be anybody's
            self.get_logger().error(f"reward of step {step.step_id} failed: {_text(error)}", throttle_duration_sec=1.0)
            return _unjudged(step, _text(error))

    def _publish(self, step: LockStep, result: RewardResult, eval_s: float) -> None:
        self._rewards.publish(
            convert.reward_msg(step, result, name=self._model.name, version=self._model.version, eval_s=eval_s)
        )
        self.diagnostics.latency("evaluate", eval_s)
        missing = int((step.valid & ~result.valid).sum())
        if missing:
            self.diagnostics.count("invalid_rewards", missing, text=f"{missing} invalid: {result.invalid_reason}")
        self._window.add(step, result)

    def _publish_summary(self) -> None:
        values = self._window.take()
        if values is not None:
            message = RewardSummary(**values)
            message.header = convert.header(self.get_clock().now().nanoseconds)
            self._summaries.publish(message)

    # Service.

    def _on_evaluate(
        self, request: EvaluateReward.Request, response: EvaluateReward.Response
    ) -> EvaluateReward.Response:
        self.require_active()
        if self._spec is None:
            raise WireError(ErrorCode.NOT_ACTIVE, "no env/spec seen yet; start an environment or replay a bag")
        goals = images_of(request.goal, self._spec) if len(request.goal.data) else None
        step = replace(
            convert.transition_of(request.transition, self._spec), images=images_of(request.observation, self._spec),
            next_images=images_of(request.next_observation, self._spec),
            goals=None if goals is None else (goals, np.ones(len(goals), bool)),
        )
        began = time.perf_counter()
        result = self._judge(step)
        response.reward = convert.reward_msg(
            step, result, name=self._model.name, version=self._model.version, eval_s=time.perf_counter() - began
        )
        return response


def _check_rewards(result: RewardResult, num_envs: int) -> None:
    """Raises ValueError: arrays of another shape, or a valid reward that is no number."""
    names = ("total", "dense", "sparse", "valid", "success")
    arrays = {**{name: getattr(result, name) for name in names}, **result.components}
    for name, array in arrays.items():
        if np.shape(array) != (num_envs,):
            raise ValueError(f"{name} of the rewards is of shape {np.shape(array)}, not ({num_envs},)")
    if not np.isfinite(result.total[result.valid]).all():
        raise ValueError("total of a valid reward is NaN or infinite")


def _text(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _unjudged(step: LockStep, reason: str) -> RewardResult:
    """A result without any reward: missing is missing, never 0."""
    count = len(step.valid)
    nan = np.full(count, np.nan, np.float32)
    return RewardResult(
        total=nan, dense=nan, sparse=nan, valid=np.zeros(count, bool),
        success=np.full(count, SUCCESS_UNKNOWN, np.uint8), invalid_reason=reason,
    )


def main() -> int:
    return run_node(RewardEvaluatorNode)


if __name__ == "__main__":
    sys.exit(main())
