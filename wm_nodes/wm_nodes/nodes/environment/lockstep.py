"""The rules of a lock-step environment: step ids, safe retry, gates, stamps, episodes. No rclpy: numpy in, numpy out.

Shapes: N environments, A action, S state, P ground truth.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from wm_msgs.msg import EpisodeEvent, ErrorCode
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals, LockStep
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import SOURCE_IMAGINED, SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.tool_control import hold_actions
from wm_nodes.core.types import BoolArray, Environment, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.nodes.environment.running_episodes import RunningEpisodes
from wm_nodes.nodes.environment.stamp_clock import StampClock
from wm_nodes.ros.wire import EpisodeNote, Reply, ResetCommand, StepCommand

UNIT_TOLERANCE = 1e-6

REPEAT_S = 1.0
"""A reset that was sent again while the first one was made waits for its end, and is taken at most so long after it."""


class Sink(Protocol):
    """Where a lock-step environment publishes; in this order for one step: image, goals, transition, episodes."""

    def image(self, images: UInt8Array, stamp_ns: int) -> None: ...

    def goals(self, goals: Goals) -> None: ...

    def transition(self, transition: LockStep) -> None: ...

    def episode(self, note: EpisodeNote) -> None: ...


@dataclass(frozen=True)
class _Plan:
    """A lock-step that is allowed, before it is made."""

    command: StepCommand
    """What was asked for."""
    actions: FloatArray
    """(N, A), checked."""
    resets: BoolArray
    """(N,), reset instead of stepped."""
    seeds: UInt64Array | None
    """(N,), used where resets is True; None where nothing is reset."""
    before: Observation
    """What the actions answer."""
    stamp_ns: int
    """Of that observation."""


@dataclass(frozen=True)
class _Reset:
    """A reset that was made, and that its sender may have asked for again meanwhile."""

    command: ResetCommand
    """What was asked for; it names its seeds."""
    reply: Reply
    """What was answered."""
    began_s: float
    """When it began, on the time.monotonic clock."""
    ended_s: float
    """When it was answered, on that clock."""

    def answers(self, command: ResetCommand) -> bool:
        """Whether a request is this one, sent again: equal, and taken sooner after the answer than that took to make.

        One that names no seeds is a new one: it asks for other seeds.
        """
        soon_s = min(self.ended_s - self.began_s, REPEAT_S)
        return command.equals(self.command) and time.monotonic() - self.ended_s < soon_s


class LockstepEnvironment:
    """Serves one Environment to one client at a time. Thread-safe.

    Args:
        environment: what is stepped.
        session: of the serving node; a command of another session is refused.
        sink: gets every published item.
        seed: root of the resets that name no seeds (stream `reset`, number of the draw).
        clock: gives the stamp of an observation, ns; every call a later one.
    """

    def __init__(
        self, environment: Environment, session: int, sink: Sink, seed: int = 0,
        clock: Callable[[], int] | None = None,
    ) -> None:
        self.environment, self.session = environment, session
        self.spec: EnvironmentSpec = environment.spec
        self.estop = False
        self.before_step: Callable[[], None] = lambda: None
        """Called before every change; raises WireError to refuse it (no credit, not active)."""
        self._sink = sink
        self._seed, self._draws = seed, 0
        self._lock = threading.Lock()
        self._clock = clock or StampClock()
        self._stamp_ns = self._last_step_id = 0
        self._told_s: float | None = None
        """When it was told something with which a robot may go on, on the time.monotonic clock; None: it stays put."""
        self._last_command: StepCommand | None = None
        self._last_reply: Reply | WireError | None = None
        self._last_reset: _Reset | None = None
        self._current: Observation | None = None
        self._episodes = RunningEpisodes(self.spec.num_envs, self.spec.max_episode_steps, sink.episode)

    @property
    def next_step_id(self) -> int:
        return self._last_step_id + 1

    def reset(self, command: ResetCommand) -> Reply:
        """Reset the masked environments. Publishes the new frame and one transition without action; the same reset that
        was sent again while it was made returns the stored answer.

        Raises:
            WireError: NOT_FOUND for another task, ESTOP, INTERNAL, or what before_step refuses.
        """
        with self._lock:
            if self._last_reset is not None and self._last_reset.answers(command):
                return self._last_reset.reply
            self._last_reset, began_s = None, time.monotonic()
            if command.task and command.task != self.spec.task:
                raise WireError(
                    ErrorCode.NOT_FOUND,
                    f"task {command.task!r} is not served here; this environment serves {self.spec.task!r}",
                )
            self._gate()
            mask = np.ones(self.spec.num_envs, bool) if command.mask is None else command.mask
            if self._current is None and not mask.all():
                raise WireError(ErrorCode.OUT_OF_ORDER, "the first reset must be of all environments; empty mask")
            seeds = self._seeds(command.seeds)
            self._episodes.end(mask, EpisodeEvent.REASON_RESET, self._stamp_ns)
            self._episodes.behaviour = command.behaviour or self._episodes.behaviour
            told_s, self._told_s = self._told_s, time.monotonic()
            with self._environment_errors():
                self._current = self.environment.reset(mask, seeds)
            self._stamp_ns, self._told_s = self._clock(), told_s and time.monotonic()
            reply = self._reply(command.with_image)
            self._last_reply = None
            self._publish_observation(goals_changed=True)
            self._episodes.start(mask, self._current.episode_id, seeds, self._stamp_ns)
            self._sink.transition(self._reset_lockstep())
            if command.seeds is not None:
                self._last_reset = _Reset(command, reply, began_s, time.monotonic())
            return reply

    def step(self, command: StepCommand) -> Reply:
        """Step once; the same command again returns the stored answer.

        Raises:
            WireError: SPEC_MISMATCH, OUT_OF_ORDER, BAD_SHAPE, NAN_INPUT, OUT_OF_RANGE, ESTOP, NAN_MODEL, INTERNAL, or
                what before_step refuses. The environment is unchanged, except after NAN_MODEL and INTERNAL (an
                exception of the environment): the episodes these name are over and must be reset.
        """
        with self._lock:
            self._check_client(command)
            if self._last_reply is None or not command.equals(self._last_command):
                plan, started = self._plan(command), time.perf_counter()
                self._last_reset, self._told_s = None, time.monotonic()
                with self._environment_errors():
                    result = self.environment.step(plan.actions)
                valid, broken = self._judge_ends(plan, result)
                self._reset_some(plan, result.observation)
                step = self._lockstep(plan, result, valid)
                reply = self._answer(plan, step, time.perf_counter() - started)
                self._publish(plan, step)
                self._last_command = command
                goes_on = result.valid & ~result.ended
                self._told_s = time.monotonic() if goes_on.any() else None
                self._last_reply = _nan_error(broken, command.step_id) if broken.any() else reply
            if isinstance(self._last_reply, WireError):
                raise self._last_reply
            return self._last_reply

    @property
    def is_robot(self) -> bool:
        """Whether it may go on with its last action between two steps; what is computed stands still."""
        return self.spec.source == SOURCE_REAL

    @property
    def left_for_s(self) -> float:
        """Time since it was told something with which a robot may go on; 0 while it works, and where it stays put."""
        told_s = self._told_s
        return 0.0 if told_s is None or self._lock.locked() else time.monotonic() - told_s

    def hold_now(self) -> BoolArray:
        """Have a robot hold, which without further steps might go on with its last action, outside of any step: by its
        own hold(), else by a step of the environment. What is imagined is left alone.

        Returns:
            (N,), whether the episode ended as it held: its environment stays put until it is reset.

        Raises:
            WireError: INTERNAL, NAN_MODEL: the environment failed.
        """
        with self._lock, self._environment_errors():
            is_untouched, self._told_s = self._current is None and self._told_s is None, None
            if self.is_robot and not is_untouched and (hold := getattr(self.environment, "hold", None)):
                hold()
            elif self._current is not None and self.spec.source != SOURCE_IMAGINED:
                result = self.environment.step(self.hold_actions())
                self._episodes.count_hold()
                return result.ended
            return np.zeros(self.spec.num_envs, bool)

    def hold_actions(self) -> FloatArray:
        """Actions (N, A) that leave every tool where it is commanded to be; zeros before the first reset."""
        if self._current is None:
            return np.zeros((self.spec.num_envs, self.spec.action_dim), np.float32)
        return hold_actions(self._current.state, self.spec)

    def check_estop(self) -> None:
        """Raise WireError(ESTOP) while the emergency stop is set."""
        if self.estop:
            raise WireError(ErrorCode.ESTOP, "the emergency stop is set; publish false on safety/estop to go on")

    def end_episodes(self, reason: int) -> None:
        """End all running episodes, e.g. when the node stops or the estop is set."""
        with self._lock:
            self._last_reset = None
            self._episodes.end(np.ones(self.spec.num_envs, bool), reason, self._stamp_ns, abort=True)

    def close(self) -> None:
        self.environment.close()

    def _check_client(self, command: StepCommand) -> None:
        if command.session != self.session:
            raise WireError(
                ErrorCode.SPEC_MISMATCH,
                f"session {command.session} is not this environment's {self.session}: it was restarted; "
                "read env/get_spec again and reset",
            )
        if command.spec_hash != self.spec.spec_hash:
            raise WireError(
                ErrorCode.SPEC_MISMATCH,
                f"spec_hash {command.spec_hash[:12]!r} is not {self.spec.spec_hash[:12]!r}; ask env/get_spec",
            )

    def _plan(self, command: StepCommand) -> _Plan:
        """What a new command asks for; refuses one that is wrong or not allowed now."""
        if command.step_id != self.next_step_id:
            raise WireError(
                ErrorCode.OUT_OF_ORDER,
                f"step_id {command.step_id} is neither the next one ({self.next_step_id}) nor the last step, sent "
                f"again; is there a second client? continue with {self.next_step_id}",
            )
        if self._current is None:
            raise WireError(ErrorCode.OUT_OF_ORDER, "never reset; call env/reset first")
        actions = self.check_actions(command.actions)
        resets = np.zeros(self.spec.num_envs, bool) if command.reset_mask is None else command.reset_mask
        seeds = self._seeds(command.reset_seeds) if resets.any() or command.reset_seeds is not None else None
        self._gate()
        return _Plan(command, actions, resets, seeds, self._current, self._stamp_ns)

    def _judge_ends(self, plan: _Plan, result: StepResult) -> tuple[BoolArray, BoolArray]:
        """End the episodes of which the model predicted NaN; return which environments stepped, and which broke."""
        finite = np.isfinite(result.observation.state).all(1) & np.isfinite(result.success_probability)
        broken = self._episodes.running & ~finite & ~plan.resets
        self._episodes.end(broken, EpisodeEvent.REASON_ERROR, plan.stamp_ns, abort=True)
        return result.valid & self._episodes.running & ~plan.resets, broken

    def _reset_some(self, plan: _Plan, observation: Observation) -> None:
        """Reset what the plan resets; what is then shown becomes the current observation."""
        if plan.resets.any():
            self._episodes.end(plan.resets, EpisodeEvent.REASON_RESET, plan.stamp_ns)
            with self._environment_errors():
                observation = self.environment.reset(plan.resets, plan.seeds)
        self._current, self._stamp_ns, self._last_step_id = observation, self._clock(), plan.command.step_id

    def _lockstep(self, plan: _Plan, result: StepResult, valid: BoolArray) -> LockStep:
        assert self._current is not None
        command, before, unknown = plan.command, plan.before, np.full(self.spec.num_envs, np.nan, np.float32)
        return LockStep(
            session=self.session, step_id=command.step_id, stamp_ns=plan.stamp_ns, next_stamp_ns=self._stamp_ns,
            actions=plan.actions, states=before.state, next_states=self._current.state,
            logprobs=unknown if command.logprobs is None else command.logprobs,
            values=unknown if command.values is None else command.values, terminated=result.terminated & valid,
            truncated=result.truncated & valid, valid=valid, episode_ids=before.episode_id,
            episode_steps=self._episodes.lengths,
            policy_versions=np.full(self.spec.num_envs, command.policy_version, np.uint64),
            success_probability=np.where(valid, result.success_probability, 0).astype(np.float32),
            uncertainty=result.uncertainty,
            ground_truth=np.where(valid[:, None], result.ground_truth, self._truth()).astype(np.float32),
            source=self.spec.source,
        )

    def _answer(self, plan: _Plan, step: LockStep, step_s: float) -> Reply:
        """Truncated here is also what was ended from outside, until it is reset."""
        return replace(
            self._reply(plan.command.with_image), terminated=step.terminated,
            truncated=step.truncated | self._episodes.aborted & ~plan.resets,
            success_probability=step.success_probability, uncertainty=step.uncertainty, step_s=step_s,
        )

    def _publish(self, plan: _Plan, step: LockStep) -> None:
        self._publish_observation(goals_changed=bool(plan.resets.any()))
        self._sink.transition(step)
        self._episodes.advance(step, plan.command.policy_version)
        if plan.seeds is not None and self._current is not None:
            self._episodes.start(plan.resets, self._current.episode_id, plan.seeds, self._stamp_ns)

    def check_actions(self, flat: FloatArray) -> FloatArray:
        """Return actions as float32 (N, A). Raises WireError: BAD_SHAPE, NAN_INPUT, OUT_OF_RANGE."""
        shape = (self.spec.num_envs, self.spec.action_dim)
        if flat.size != shape[0] * shape[1]:
            raise WireError(
                ErrorCode.BAD_SHAPE, f"action has {flat.size} values, expected {shape} (num_envs, action_dim)"
            )
        actions = np.array(flat, np.float32).reshape(shape)
        if not np.isfinite(actions).all():
            bad = np.flatnonzero(~np.isfinite(actions).all(1)).tolist()
            raise WireError(ErrorCode.NAN_INPUT, f"action is NaN or infinite in environments {bad}; send finite values")
        worst = float(actions.flat[np.abs(actions).argmax()])
        if abs(worst) > 1.0 + UNIT_TOLERANCE:
            raise WireError(
                ErrorCode.OUT_OF_RANGE,
                f"action {worst:g} lies outside [-1, 1]; actions are normalised, divide by EnvSpec.action_scale",
            )
        return actions

    @contextmanager
    def _environment_errors(self) -> Iterator[None]:
        """Turn what the environment raises into NAN_MODEL or INTERNAL, after ending all episodes."""
        try:
            yield
        except Exception as error:
            self._episodes.abort_all(EpisodeEvent.REASON_ERROR, self._stamp_ns)
            code = ErrorCode.NAN_MODEL if isinstance(error, FloatingPointError) else ErrorCode.INTERNAL
            text = f"the environment failed: {type(error).__name__}: {error}; all episodes are over, reset them"
            raise WireError(code, text) from error

    def _gate(self) -> None:
        self.check_estop()
        self.before_step()

    def _seeds(self, seeds: UInt64Array | None) -> UInt64Array:
        """The given seeds (N,), else drawn ones, so that every episode event names the seed that made it."""
        if seeds is None:
            self._draws += 1
            return numpy_stream(self._seed, "reset", self._draws).integers(0, 2**32, self.spec.num_envs, np.uint64)
        if seeds.shape != (self.spec.num_envs,):
            raise WireError(ErrorCode.BAD_SHAPE, f"{len(seeds)} seeds for {self.spec.num_envs} environments")
        return seeds

    def _reply(self, with_image: bool) -> Reply:
        assert self._current is not None
        none, zeros = np.zeros(self.spec.num_envs, bool), np.zeros(self.spec.num_envs, np.float32)
        return Reply(
            session=self.session, step_id=self._last_step_id, stamp_ns=self._stamp_ns,
            images=self._current.image if with_image else None, states=self._current.state, terminated=none,
            truncated=none, episode_ids=self._current.episode_id, success_probability=zeros, uncertainty=zeros,
        )

    def _reset_lockstep(self) -> LockStep:
        assert self._current is not None
        count, stamp, current = self.spec.num_envs, self._stamp_ns, self._current
        zeros, none, unknown = np.zeros(count, np.float32), np.zeros(count, bool), np.full(count, np.nan, np.float32)
        return LockStep(
            session=self.session, step_id=self._last_step_id, stamp_ns=stamp, next_stamp_ns=stamp,
            actions=np.zeros((count, self.spec.action_dim), np.float32), states=current.state,
            next_states=current.state, logprobs=unknown, values=unknown, terminated=none, truncated=none, valid=none,
            episode_ids=current.episode_id, episode_steps=self._episodes.lengths,
            policy_versions=np.zeros(count, np.uint64), success_probability=zeros, uncertainty=zeros,
            ground_truth=self._truth(), source=self.spec.source,
        )

    def _truth(self) -> FloatArray:
        """Simulator truth of the current observation; NaN where only step results tell."""
        shape = (self.spec.num_envs, self.spec.ground_truth_dim)
        truth: FloatArray | None = getattr(self.environment, "ground_truth", None)
        return np.full(shape, np.nan, np.float32) if truth is None else truth

    def _publish_observation(self, *, goals_changed: bool) -> None:
        assert self._current is not None
        self._sink.image(self._current.image, self._stamp_ns)
        if goals_changed:
            with self._environment_errors():
                goals = self.environment.goals()
            images, known = (None, np.zeros(self.spec.num_envs, bool)) if goals is None else goals
            self._sink.goals(Goals(self._stamp_ns, images, known, self._current.episode_id, self.session))


def _nan_error(broken: BoolArray, step_id: int) -> WireError:
    return WireError(
        ErrorCode.NAN_MODEL,
        f"the model produced NaN in environments {np.flatnonzero(broken).tolist()} at step {step_id}; their episodes "
        "are over, reset them",
    )
