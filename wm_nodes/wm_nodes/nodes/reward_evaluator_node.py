"""reward_evaluator: judges every transition, after joining it with its two images by exact stamp and with its goals;
with the reward agent, every episode at its end."""

import sys
import time
from collections import OrderedDict, deque
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Image

from wm_msgs.msg import EnvSpec, ErrorCode, RewardSummary, TaskGoal, TransitionBatch
from wm_msgs.srv import EvaluateReward
from wm_nodes.config.schema import AGENT
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, UInt8Array
from wm_nodes.judge.episode_reward import EpisodeReward, EpisodeStep, PendingReward, episode_judge
from wm_nodes.nodes.factories import REWARDS, make_reward
from wm_nodes.nodes.judge import services
from wm_nodes.nodes.judge.services import JudgeServices
from wm_nodes.nodes.learner.rollout_assembler import ImageCache
from wm_nodes.nodes.reward.summary import SummaryWindow
from wm_nodes.reward import RewardInput, RewardModel, RewardResult
from wm_nodes.reward.base import SUCCESS_UNKNOWN
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.qos import CREDIT_WINDOW
from wm_nodes.ros.sequence_numbers import check_session
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.wire import Transition, WireError

PARAMS = (
    Param("reward", "endogenous", "Reward model", read_only=True, choices=REWARDS),
    Param("model_dir", "", "World-model folder, for the endogenous reward's distance", read_only=True),
    Param("image_wait_s", 1.0, "A transition waits for its images and goals at most so long", "s",
          minimum=0.0, maximum=60.0),
    Param("summary_period_s", 1.0, "Time between two reward/summary", "s", minimum=0.1, maximum=60.0),
    *services.PARAMS,
)

GOALS_KEPT_PER_ENV = 2 * CREDIT_WINDOW


class RewardEvaluatorNode(ManagedNode):
    """Listens to env/spec, env/image, env/transition, env/goal; publishes reward, reward/summary; with the agent also
    what JudgeServices has."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("reward_evaluator", PARAMS, **node_arguments)
        self._agent: JudgeServices | None = None

    def configure(self) -> None:
        config, kind = self.run_config(), str(self.param("reward"))
        self._agent = None
        self._undecided: deque[tuple[float, Transition, PendingReward]] = deque()
        self._model: RewardModel | EpisodeReward
        if kind == AGENT and not config.reward.factory:
            agent = JudgeServices(self, episode_judge(config), config, lambda: bool(self._undecided))
            self._model = EpisodeReward(agent.judge)
            self._agent = agent
        else:
            self._model = make_reward(kind, config, str(self.param("model_dir")))
        self._spec: EnvironmentSpec | None = None
        self._session = 0
        self._images = ImageCache(4 * CREDIT_WINDOW)
        self._goals: OrderedDict[int, tuple[UInt8Array | None, bool]] = OrderedDict()
        self._goals_expected = True
        self._waiting: list[tuple[float, Transition]] = []
        self._window = SummaryWindow()
        self._rewards = self.publish_on("reward")
        self._summaries = self.publish_on("reward/summary")
        self.listen("env/spec", self._on_spec, while_inactive=True)
        self.listen("env/image", self._on_image)
        self.listen("env/goal", self._on_goal, while_inactive=True)
        self.listen("env/transition", self._on_transition, credit=True)
        self.serve(EvaluateReward, "reward/evaluate", self._on_evaluate)
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
            self._spec = convert.spec_from_msg(message)
        except WireError as error:
            self.diagnostics.count("refused_specs", level=diagnostics.ERROR, text=str(error))
            return
        self._enter_session(message.session)

    def _enter_session(self, session: int) -> None:
        """Episode ids start again with every environment process, in older recordings stamps do, too: what came from
        the one before must not be joined."""
        if session != self._session:
            self._session = session
            self._images.clear()
            self._goals.clear()
            self._goals_expected = True
            self._waiting.clear()
            self._drop_undecided()
            self._window.forget_episodes()

    def _on_image(self, message: Image) -> None:
        if self._spec is None:
            return
        self._images.put(convert.time_ns(message.header.stamp), convert.images_of(message, self._spec))
        self._judge_waiting()

    def _on_goal(self, message: TaskGoal) -> None:
        if self._spec is None:
            return
        check_session(message.session, self._session)
        goals = convert.goals_of(message, self._spec)
        self._enter_session(message.session)
        for i, episode_id in enumerate(goals.episode_ids):
            self._goals[int(episode_id)] = (None if goals.images is None else goals.images[i], bool(goals.found[i]))
        self._judge_waiting()
        while len(self._goals) > GOALS_KEPT_PER_ENV * self._spec.num_envs:
            self._goals.popitem(last=False)

    def _on_transition(self, message: TransitionBatch) -> None:
        if self._spec is None:
            self.diagnostics.count("before_spec", text="a transition came before env/spec; it gets no reward")
            return
        check_session(message.session, self._session)
        transition = convert.transition_of(message, self._spec)
        self._enter_session(message.session)
        if not transition.is_reset and transition.valid.any():
            self._waiting.append((time.monotonic(), transition))
            self._judge_waiting()

    def _judge_waiting(self) -> None:
        """Judge, in order, the transitions whose images are there or are overdue."""
        while self._waiting:
            since, transition = self._waiting[0]
            images, next_images = self._images.get(transition.stamp_ns), self._images.get(transition.next_stamp_ns)
            complete = images is not None and next_images is not None and self._has_goals(transition)
            if not complete and time.monotonic() - since < float(self.param("image_wait_s")):
                return
            if images is not None and next_images is not None and not complete and not self._goals:
                self._goals_expected = False
            self._waiting.pop(0)
            if isinstance(self._model, EpisodeReward):
                self._collect(self._model, transition, images, next_images)
            elif images is None or next_images is None:
                missing = transition.stamp_ns if images is None else transition.next_stamp_ns
                self._publish(transition, _unjudged(transition, f"no image with stamp {missing} ns"), 0.0)
            else:
                began = time.perf_counter()
                result = self._judge(transition, images, next_images, *self._goals_of(transition, images))
                self._publish(transition, result, time.perf_counter() - began)
            self._images.drop_before(transition.stamp_ns)

    # Whole episodes, judged while the graph goes on; rewards leave in the order of their steps.

    def _on_timer(self) -> None:
        self._judge_waiting()
        self._publish_decided()

    def _collect(
        self, model: EpisodeReward, transition: Transition, images: UInt8Array | None, next_images: UInt8Array | None
    ) -> None:
        assert self._spec is not None  # transitions wait for it
        goals = {n: self._goals.get(int(episode_id)) for n, episode_id in enumerate(transition.episode_ids)}
        step = EpisodeStep(
            images, next_images, transition.actions, transition.episode_ids, transition.episode_steps,
            transition.terminated | transition.truncated, transition.valid,
            {n: goal[0] for n, goal in goals.items() if goal is not None and goal[0] is not None and goal[1]},
        )
        pending = model.add(step, self._spec, transition.session)
        self._undecided.append((time.perf_counter(), transition, pending))
        self._publish_decided()

    def _publish_decided(self) -> None:
        while self._agent is not None and self._undecided and self._undecided[0][2].done:
            since, transition, pending = self._undecided.popleft()
            for env, verdict in pending.verdicts().items():
                self._agent.publish(
                    verdict, clip=env, iteration=transition.step_id, stamp_ns=transition.stamp_ns
                )
            self._publish(transition, pending.result(), time.perf_counter() - since)

    def _drop_undecided(self) -> None:
        """Forget what is being judged and what has not ended: it belongs to nobody any more."""
        for _, _, pending in self._undecided:
            pending.cancel()
        self._undecided.clear()
        if isinstance(self._model, EpisodeReward):
            self._model.forget()

    def _has_goals(self, transition: Transition) -> bool:
        """Whether the goal message of every stepped episode is there; a bag without goals is waited for only once."""
        judged = transition.episode_ids[transition.valid]
        return not self._goals_expected or all(int(episode_id) in self._goals for episode_id in judged)

    def _goals_of(self, transition: Transition, images: UInt8Array) -> tuple[UInt8Array | None, BoolArray | None]:
        episode_goals = [self._goals.get(int(episode_id)) for episode_id in transition.episode_ids]
        if all(goal is None or goal[0] is None for goal in episode_goals):
            return None, None
        goals = np.zeros_like(images)
        there = np.zeros(len(images), bool)
        for i, goal in enumerate(episode_goals):
            if goal is not None and goal[0] is not None:
                goals[i], there[i] = goal
        return goals, there

    def _judge(
        self, transition: Transition, images: UInt8Array, next_images: UInt8Array, goals: UInt8Array | None,
        goal_found: BoolArray | None,
    ) -> RewardResult:
        model = self._model
        if isinstance(model, EpisodeReward):
            return _unjudged(transition, "the reward agent judges whole episodes, not single steps")
        try:
            step = RewardInput(
                images=images, next_images=next_images, success_probability=transition.success_probability,
                valid=transition.valid, uncertainty=transition.uncertainty, goals=goals, goal_found=goal_found,
            )
            return model.evaluate(step)
        except (ValueError, RuntimeError) as error:
            self.get_logger().error(f"reward of step {transition.step_id} failed: {error}")
            return _unjudged(transition, f"{type(error).__name__}: {error}")

    def _publish(self, transition: Transition, result: RewardResult, eval_s: float) -> None:
        self._rewards.publish(
            convert.reward_msg(transition, result, name=self._model.name, version=self._model.version, eval_s=eval_s)
        )
        self.diagnostics.latency("evaluate", eval_s)
        missing = int((transition.valid & ~result.valid).sum())
        if missing:
            self.diagnostics.count("invalid_rewards", missing, text=f"{missing} invalid: {result.invalid_reason}")
        self._window.add(transition, result)

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
        try:
            if not self.active:
                raise WireError(ErrorCode.NOT_ACTIVE, "the reward evaluator is not active; activate it first")
            if self._spec is None:
                raise WireError(ErrorCode.NOT_ACTIVE, "no env/spec seen yet; start an environment or replay a bag")
            transition = convert.transition_of(request.transition, self._spec)
            images = convert.images_of(request.observation, self._spec)
            next_images = convert.images_of(request.next_observation, self._spec)
            goals = convert.images_of(request.goal, self._spec) if len(request.goal.data) else None
        except WireError as error:
            self.count_refused("evaluation", error)
            return convert.fill_error(response, error)
        began = time.perf_counter()
        result = self._judge(transition, images, next_images, goals, None)
        response.reward = convert.reward_msg(
            transition, result, name=self._model.name, version=self._model.version, eval_s=time.perf_counter() - began
        )
        return response


def _unjudged(transition: Transition, reason: str) -> RewardResult:
    """A result without any reward: missing is missing, never 0."""
    count = len(transition.valid)
    nan = np.full(count, np.nan, np.float32)
    return RewardResult(
        total=nan, dense=nan, sparse=nan, valid=np.zeros(count, bool),
        success=np.full(count, SUCCESS_UNKNOWN, np.uint8), invalid_reason=reason,
    )


def main() -> int:
    return run_node(RewardEvaluatorNode)


if __name__ == "__main__":
    sys.exit(main())
