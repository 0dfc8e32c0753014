"""The rules of a lock-step environment: step ids, safe retry, gates, stamps, episodes. No rclpy: numpy in, numpy out.

Shapes: N environments, A action, S state, P ground truth.

A stamp is the wall time at which an observation was made. Nothing that is computed depends on it.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from wm_msgs.msg import EpisodeEvent, ErrorCode
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.tool_control import hold_actions
from wm_nodes.core.types import BoolArray, Environment, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.ros.wire import EpisodeNote, Goals, Reply, ResetCommand, StepCommand, Transition, WireError

UNIT_TOLERANCE = 1e-6


class StampClock:
    """Gives the stamps of one node's observations: wall time, and always later than the stamp before.

    now_ns: ns since the epoch; it may stand still or jump back.
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._now_ns, self._last_ns = now_ns, 0

    def __call__(self) -> int:
        self._last_ns = max(self._now_ns(), self._last_ns + 1)
        return self._last_ns


class Sink(Protocol):
    """Where a lock-step environment publishes; in this order for one step: image, goals, transition, episodes."""

    def image(self, images: UInt8Array, stamp_ns: int) -> None: ...

    def goals(self, goals: Goals) -> None: ...

    def transition(self, transition: Transition) -> None: ...

    def episode(self, note: EpisodeNote) -> None: ...


@dataclass
class _Slot:
    """The running episode of one environment."""

    episode_id: int = 0
    seed: int = 0
    running: bool = False
    aborted: bool = False
    """Ended from outside (estop, error, stop): nothing it does counts until it is reset."""
    length: int = 0
    version_first: int = 0
    version_last: int = 0


class LockstepEnvironment:
    """Serves one Environment to one client at a time. Thread-safe.

    Args:
        environment: what is stepped.
        session: of the serving node; a command of another session is refused.
        sink: gets every published item.
        behaviour: label of the episode events until a reset names another.
        seed: root of the resets that name no seeds (stream `reset`, number of the draw).
        clock: gives the stamp of an observation, ns; every call a later one.
    """

    def __init__(
        self, environment: Environment, session: int, sink: Sink, behaviour: str = "policy", seed: int = 0,
        clock: Callable[[], int] | None = None,
    ) -> None:
        self.environment, self.session = environment, session
        self.spec: EnvironmentSpec = environment.spec
        self.estop = False
        self.before_step: Callable[[], None] = lambda: None
        """Called before every change; raises WireError to refuse it (no credit, not active)."""
        self._sink = sink
        self._behaviour = behaviour
        self._seed, self._draws = seed, 0
        self._lock = threading.Lock()
        self._clock = clock or StampClock()
        self._stamp_ns = 0
        self._last_step_id = 0
        self._last_reply: Reply | WireError | None = None
        self._current: Observation | None = None
        self._slots = [_Slot() for _ in range(self.spec.num_envs)]

    @property
    def next_step_id(self) -> int:
        return self._last_step_id + 1

    def reset(self, command: ResetCommand) -> Reply:
        """Reset the masked environments. Publishes the new frame and one transition without action.

        Raises:
            WireError: NOT_FOUND for another task, ESTOP, INTERNAL, or what before_step refuses.
        """
        with self._lock:
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
            self._end_episodes(mask, EpisodeEvent.REASON_RESET, self._stamp_ns)
            self._behaviour = command.behaviour or self._behaviour
            with self._environment_errors():
                self._current = self.environment.reset(mask, seeds)
            stamp = self._stamp_ns = self._clock()
            reply = self._reply(stamp, command.with_image)
            self._last_reply = None
            self._publish_observation(stamp, goals_changed=True)
            self._start_episodes(mask, seeds, stamp)
            self._sink.transition(self._reset_transition(stamp))
            return reply

    def step(self, command: StepCommand) -> Reply:
        """Step once; the same step_id again returns the stored answer.

        Raises:
            WireError: SPEC_MISMATCH, OUT_OF_ORDER, BAD_SHAPE, NAN_INPUT, OUT_OF_RANGE, ESTOP, NAN_MODEL, INTERNAL, or
                what before_step refuses. The environment is unchanged, except after NAN_MODEL and INTERNAL (an
                exception of the environment): the episodes these name are over and must be reset.
        """
        with self._lock:
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
            if self._last_reply is not None and command.step_id == self._last_step_id:
                if isinstance(self._last_reply, WireError):
                    raise self._last_reply
                return self._last_reply
            if command.step_id != self.next_step_id:
                raise WireError(
                    ErrorCode.OUT_OF_ORDER,
                    f"step_id {command.step_id} is neither the last one ({self._last_step_id}) nor the next one "
                    f"({self.next_step_id}); continue with {self.next_step_id}",
                )
            if self._current is None:
                raise WireError(ErrorCode.OUT_OF_ORDER, "never reset; call env/reset first")
            actions = self.check_actions(command.actions)
            resets = command.reset_seeds is not None or (command.reset_mask is not None and command.reset_mask.any())
            seeds = self._seeds(command.reset_seeds) if resets else None
            self._gate()
            return self._step(command, actions, seeds)

    def hold_now(self) -> None:
        """Have a robot hold, which without further steps might go on with its last action, outside of any step.

        Raises:
            WireError: INTERNAL, NAN_MODEL: the environment failed.
        """
        with self._lock, self._environment_errors():
            if self._current is not None:
                self.environment.step(self.hold_actions())

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
            self._abort(np.ones(self.spec.num_envs, bool), reason, self._stamp_ns)

    def close(self) -> None:
        self.environment.close()

    def _step(self, command: StepCommand, actions: FloatArray, seeds: UInt64Array | None) -> Reply:
        started = time.perf_counter()
        before, before_stamp = self._current, self._stamp_ns
        assert before is not None
        with self._environment_errors():
            result = self.environment.step(actions)
        mask = command.reset_mask
        broken = self._running() & ~_finite(result)
        if mask is not None:
            broken &= ~mask
        self._abort(broken, EpisodeEvent.REASON_ERROR, before_stamp)
        valid = result.valid & self._running()
        observation = result.observation
        if mask is not None and mask.any():
            self._end_episodes(mask, EpisodeEvent.REASON_RESET, before_stamp)
            with self._environment_errors():
                observation = self.environment.reset(mask, seeds)
            valid &= ~mask
        self._current = observation
        stamp = self._stamp_ns = self._clock()
        self._last_step_id = command.step_id
        aborted = self._aborted() if mask is None else self._aborted() & ~mask
        success = np.where(valid, result.success_probability, 0).astype(np.float32)
        truth = np.where(valid[:, None], result.ground_truth, self._truth()).astype(np.float32)
        reply = replace(
            self._reply(stamp, command.with_image), terminated=result.terminated & valid,
            truncated=result.truncated & valid | aborted, success_probability=success, uncertainty=result.uncertainty,
            step_s=time.perf_counter() - started,
        )
        self._publish_observation(stamp, goals_changed=mask is not None and bool(mask.any()))
        count = self.spec.num_envs
        unknown = np.full(count, np.nan, np.float32)
        self._sink.transition(
            Transition(
                stamp_ns=before_stamp, next_stamp_ns=stamp, step_id=command.step_id, actions=actions,
                states=before.state, next_states=observation.state,
                logprobs=unknown if command.logprobs is None else command.logprobs,
                values=unknown if command.values is None else command.values, terminated=reply.terminated,
                truncated=result.truncated & valid, valid=valid, episode_ids=before.episode_id,
                episode_steps=before.episode_step, policy_versions=np.full(count, command.policy_version, np.uint64),
                success_probability=success, uncertainty=result.uncertainty, ground_truth=truth,
                source=self.spec.source,
            )
        )
        self._note_progress(valid, reply, command.policy_version, stamp)
        if mask is not None and mask.any():
            assert seeds is not None
            self._start_episodes(mask, seeds, stamp)
        self._last_reply = reply
        if broken.any():
            self._last_reply = WireError(
                ErrorCode.NAN_MODEL,
                f"the model produced NaN in environments {np.flatnonzero(broken).tolist()} at step {command.step_id}; "
                "their episodes are over, reset them",
            )
            raise self._last_reply
        return reply

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
            self._abort(np.ones(self.spec.num_envs, bool), EpisodeEvent.REASON_ERROR, self._stamp_ns)
            for slot in self._slots:
                slot.aborted = True
            code = ErrorCode.NAN_MODEL if isinstance(error, FloatingPointError) else ErrorCode.INTERNAL
            text = f"the environment failed: {type(error).__name__}: {error}; all episodes are over, reset them"
            raise WireError(code, text) from error

    def _running(self) -> BoolArray:
        return np.array([slot.running for slot in self._slots])

    def _aborted(self) -> BoolArray:
        return np.array([slot.aborted for slot in self._slots])

    def _abort(self, mask: BoolArray, reason: int, stamp: int) -> None:
        """End running episodes from outside: their environments do nothing valid until they are reset."""
        for i in np.flatnonzero(mask & self._running()):
            self._end(int(i), EpisodeEvent.OUTCOME_UNKNOWN, reason, stamp)
            self._slots[i].aborted = True

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

    def _reply(self, stamp: int, with_image: bool) -> Reply:
        assert self._current is not None
        count = self.spec.num_envs
        none = np.zeros(count, bool)
        zeros = np.zeros(count, np.float32)
        return Reply(
            session=self.session, step_id=self._last_step_id, stamp_ns=stamp,
            images=self._current.image if with_image else None, states=self._current.state, terminated=none,
            truncated=none, episode_ids=self._current.episode_id, success_probability=zeros, uncertainty=zeros,
        )

    def _reset_transition(self, stamp: int) -> Transition:
        assert self._current is not None
        count = self.spec.num_envs
        zeros, none, unknown = np.zeros(count, np.float32), np.zeros(count, bool), np.full(count, np.nan, np.float32)
        current = self._current
        return Transition(
            stamp_ns=stamp, next_stamp_ns=stamp, step_id=self._last_step_id,
            actions=np.zeros((count, self.spec.action_dim), np.float32), states=current.state,
            next_states=current.state, logprobs=unknown, values=unknown, terminated=none, truncated=none, valid=none,
            episode_ids=current.episode_id, episode_steps=current.episode_step,
            policy_versions=np.zeros(count, np.uint64), success_probability=zeros, uncertainty=zeros,
            ground_truth=self._truth(), source=self.spec.source,
        )

    def _truth(self) -> FloatArray:
        """Simulator truth of the current observation; NaN where only step results tell."""
        shape = (self.spec.num_envs, self.spec.ground_truth_dim)
        truth: FloatArray | None = getattr(self.environment, "ground_truth", None)
        return np.full(shape, np.nan, np.float32) if truth is None else truth

    def _publish_observation(self, stamp: int, *, goals_changed: bool) -> None:
        assert self._current is not None
        self._sink.image(self._current.image, stamp)
        if goals_changed:
            with self._environment_errors():
                goals = self.environment.goals()
            images, found = (None, np.zeros(self.spec.num_envs, bool)) if goals is None else goals
            self._sink.goals(Goals(stamp, images, found, self._current.episode_id))

    def _start_episodes(self, mask: BoolArray, seeds: UInt64Array, stamp: int) -> None:
        assert self._current is not None
        for i in np.flatnonzero(mask):
            self._slots[i] = _Slot(episode_id=int(self._current.episode_id[i]), seed=int(seeds[i]), running=True)
            self._note(int(i), EpisodeEvent.KIND_START, EpisodeEvent.OUTCOME_UNKNOWN, EpisodeEvent.REASON_NONE, stamp)

    def _note_progress(self, valid: BoolArray, reply: Reply, version: int, stamp: int) -> None:
        for i in np.flatnonzero(valid):
            slot = self._slots[i]
            slot.version_first = slot.version_first if slot.length else version
            slot.version_last = version
            slot.length += 1
            if reply.terminated[i]:
                self._end(int(i), EpisodeEvent.OUTCOME_SUCCESS, EpisodeEvent.REASON_TERMINAL, stamp)
            elif reply.truncated[i]:
                at_limit = slot.length >= self.spec.max_episode_steps
                reason = EpisodeEvent.REASON_TIME_LIMIT if at_limit else EpisodeEvent.REASON_UNCERTAINTY
                self._end(int(i), EpisodeEvent.OUTCOME_FAILURE, reason, stamp)

    def _end_episodes(self, mask: BoolArray, reason: int, stamp: int) -> None:
        for i in np.flatnonzero(mask):
            if self._slots[i].running:
                self._end(int(i), EpisodeEvent.OUTCOME_UNKNOWN, reason, stamp)

    def _end(self, i: int, outcome: int, reason: int, stamp: int) -> None:
        self._slots[i].running = False
        self._note(i, EpisodeEvent.KIND_END, outcome, reason, stamp)

    def _note(self, i: int, kind: int, outcome: int, reason: int, stamp: int) -> None:
        slot = self._slots[i]
        note = EpisodeNote(
            stamp_ns=stamp, kind=kind, env_index=i, episode_id=slot.episode_id, seed=slot.seed,
            behaviour=self._behaviour, length=slot.length, outcome=outcome, reason=reason,
            policy_version_first=slot.version_first, policy_version_last=slot.version_last,
        )
        self._sink.episode(note)


def _finite(result: StepResult) -> BoolArray:
    """(N,): state and success probability are numbers."""
    finite: BoolArray = np.isfinite(result.observation.state).all(1) & np.isfinite(result.success_probability)
    return finite
