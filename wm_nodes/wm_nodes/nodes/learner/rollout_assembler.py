"""Joins what the graph publishes about rollouts, of a policy that acts now or of a bag that a player replays.

Shapes: N environments, H W 3 image.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from wm_nodes.core.lockstep import DroppedTransitions, LockStep, Rewards
from wm_nodes.core.types import Rollout, UInt8Array
from wm_nodes.recording.join import Joiner, begins_rollout, rollout_of, rollout_problem, version_of
from wm_nodes.ros.wire import PeerLost

MAX_WAITING = 2
"""Replayed rollouts that may wait for the learner before the player's credit is withheld."""

MAX_KEPT = 4 * MAX_WAITING
"""Replayed rollouts kept of a player that knows no credit (ros2 bag play); later ones are lost and counted."""


@dataclass
class _Group:
    """The lock-steps of one rollout, by step id."""

    steps: dict[int, LockStep] = field(default_factory=dict)
    ended_s: float = 0.0
    """When it ended, on the time.monotonic clock."""

    @property
    def first(self) -> LockStep | None:
        return next(iter(self.steps.values()), None)

    @property
    def transitions(self) -> int:
        return sum(len(step.valid) for step in self.steps.values())


class RolloutAssembler:
    """Collects rollouts between begin() and end(). Thread-safe: callbacks put, the worker waits and takes.

    Live: the policy says which step ids its rollout has; missing() and take() are for these. Replayed: the stream is
    cut at resets, restarts and other policy versions, as recording.read_rollouts cuts the bag; take_replayed() gives
    the oldest rollout.

    heard_s: when the last message came, on the time.monotonic clock.

    Args:
        withhold: called with True when the player must wait (too many rollouts are ready), with False to go on.
    """

    def __init__(self, withhold: Callable[[bool], None] = lambda withheld: None) -> None:
        self._changed = threading.Condition()
        self._withhold = withhold
        self._joiner = Joiner(with_rewards=True)
        self._session = 0
        self._current = _Group()
        self._ended: deque[_Group] = deque()
        self._collecting = False
        self._num_steps: int | None = None
        self._overrun = 0
        self.heard_s = 0.0

    @property
    def collecting(self) -> bool:
        return self._collecting

    @property
    def num_collected(self) -> int:
        """Lock-steps of the unfinished rollout that have come; resets are none."""
        return len(self._current.steps)

    @property
    def waiting(self) -> int:
        """Replayed rollouts that have ended and were not taken yet."""
        return len(self._ended)

    def begin(self, num_steps: int | None = None) -> None:
        """Forget everything and collect from now on. num_steps: of replayed rollouts; None: a live one."""
        with self._changed:
            self._clear()
            self._collecting, self._num_steps, self._overrun = True, num_steps, 0
            self.heard_s = time.monotonic()

    def end(self) -> None:
        """Collect nothing until begin()."""
        with self._changed:
            self._clear()
            self._collecting = False
            self._withhold(False)

    def enter_session(self, session: int) -> None:
        """The environment was (re)started: a live rollout that has begun is worthless, a replayed one has ended."""
        with self._changed:
            if session == self._session:
                return
            self._session = session
            if self._num_steps is None:
                self._current = _Group()
            else:
                self._finish()

    def put_image(self, stamp_ns: int, images: UInt8Array) -> None:
        self._put(lambda: self._joiner.put_image(stamp_ns, images))

    def put_rewards(self, rewards: Rewards) -> None:
        self._put(lambda: self._joiner.put_rewards(rewards))

    def put_transition(self, step: LockStep) -> None:
        self.enter_session(step.session)
        self._put(lambda: self._add(step))

    def wait(self, seconds: float) -> None:
        """Return after the next put, or after `seconds`."""
        with self._changed:
            self._changed.wait(seconds)

    # Live.

    def missing(self, session: int, first: int, last: int) -> list[int]:
        """Return the step ids first..last (inclusive) that lack their transition, an image or their rewards."""
        with self._changed:
            steps = self._current.steps if session == self._session else {}
            return [n for n in range(first, last + 1) if n not in steps or not self._joiner.is_complete(steps[n])]

    def take(self, session: int, first: int, last: int, policy_version: int) -> tuple[Rollout, DroppedTransitions]:
        """Return the rollout of step ids first..last. Incomplete steps are invalid and counted as gaps.

        Raises:
            PeerLost: the environment was restarted since.
            ValueError: not a single step is complete.
        """
        with self._changed:
            if session != self._session:
                raise PeerLost("the environment was restarted before its rollout was taken")
            missing = set(self.missing(session, first, last))
            joined = self._joiner.joined
            steps = [None if n in missing else joined(self._current.steps[n]) for n in range(first, last + 1)]
        return rollout_of(steps, policy_version)

    # Replayed.

    def finish(self) -> None:
        """The stream has ended: what is unfinished will stay so."""
        with self._changed:
            self._finish()

    def take_replayed(self, patience_s: float) -> tuple[int, Rollout | None, DroppedTransitions] | None:
        """Return the oldest rollout that has ended, with its policy version; None while there is none yet.

        A rollout of num_steps has also ended when nothing follows it for `patience_s`. One that lacks steps, images or
        rewards `patience_s` after its end is given as None, its transitions as gaps.
        """
        with self._changed:
            now = time.monotonic()
            if len(self._current.steps) == self._num_steps and now - self.heard_s > patience_s:
                self._finish()
            if not self._ended:
                return None
            group = self._ended[0]
            held = [group.steps[n] for n in sorted(group.steps)]
            steps = [self._joiner.joined(step) for step in held]
            problem = rollout_problem(steps, self._num_steps)
            if problem and len(steps) == self._num_steps and now - group.ended_s < patience_s:
                return None
            self._ended.popleft()
            self._joiner.release(held)
            self._joiner.holding = bool(self._ended or self._current.steps)
            lost, self._overrun = self._overrun, 0
            if len(self._ended) < MAX_WAITING:
                self._withhold(False)
        version = version_of(steps[0])
        if problem:
            return version, None, DroppedTransitions(gap=lost + group.transitions)
        rollout, dropped = rollout_of(steps, version)
        return version, rollout, DroppedTransitions(dropped.invalid, dropped.gap + lost, dropped.stale)

    def _put(self, put: Callable[[], None]) -> None:
        with self._changed:
            if self._collecting:
                self.heard_s = time.monotonic()
                put()
                self._changed.notify_all()

    def _add(self, step: LockStep) -> None:
        if self._num_steps is not None and begins_rollout(step, self._current.first):
            self._finish()
        if step.is_reset:
            return
        self._current.steps[step.step_id] = step
        self._joiner.holding = True
        if self._num_steps is not None and len(self._ended) >= MAX_WAITING:
            self._withhold(True)

    def _finish(self) -> None:
        group, self._current = self._current, _Group()
        if len(self._ended) >= MAX_KEPT:
            self._overrun += group.transitions
        elif group.steps:
            group.ended_s = time.monotonic()
            self._ended.append(group)

    def _clear(self) -> None:
        self._joiner.clear()
        self._joiner.holding = False
        self._ended.clear()
        self._current = _Group()
