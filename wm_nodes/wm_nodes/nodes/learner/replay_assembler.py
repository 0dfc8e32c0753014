"""Cuts what a player publishes into rollouts. Nothing is asked of an environment or a policy, nothing comes twice."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from wm_nodes.core.types import Rollout, UInt8Array
from wm_nodes.nodes.learner.rollout_assembler import ImageCache, RolloutAssembler
from wm_nodes.policy_rl.training_run import DroppedTransitions
from wm_nodes.ros.wire import Rewards, Transition

MAX_WAITING = 2
"""Finished rollouts that may wait for the learner before the player's credit is withheld."""

MAX_KEPT = 4 * MAX_WAITING
"""Finished rollouts kept of a player that knows no credit (ros2 bag play); later ones are lost and counted."""

RECENT = 64
"""Images and rewards kept for a rollout that begins after them; a player's topics are not ordered among each other."""


@dataclass
class _Group:
    """The lock-steps of one (session, policy version) since a reset. done_s: when it ended, time.monotonic()."""

    version: int
    assembler: RolloutAssembler = field(default_factory=RolloutAssembler)
    steps: set[int] = field(default_factory=set)
    envs: int = 0
    done_s: float = 0.0

    @property
    def span(self) -> tuple[int, int, int]:
        return self.assembler.session, min(self.steps), max(self.steps)

    @property
    def complete(self) -> bool:
        return not self.assembler.missing(*self.span)


class ReplayAssembler:
    """Joins messages into rollouts of `num_steps` lock-steps between two resets, session or policy-version changes, as
    recording.read_rollouts does with the bag itself. Thread-safe: callbacks put, the worker takes.

    Args:
        withhold: called with True when the player must wait (too many rollouts are ready), with False to go on.
    """

    def __init__(self, withhold: Callable[[bool], None]) -> None:
        self._changed = threading.Condition()
        self._withhold = withhold
        self._images = ImageCache(RECENT)
        self._rewards: deque[Rewards] = deque(maxlen=RECENT)
        self._current: _Group | None = None
        self._done: deque[_Group] = deque()
        self._session = 0
        self._num_steps = 0
        self._overrun = 0
        self.heard_s = 0.0

    @property
    def collecting(self) -> bool:
        return self._num_steps > 0

    @property
    def waiting(self) -> int:
        """Rollouts that have ended and were not taken yet."""
        return len(self._done)

    def begin(self, num_steps: int) -> None:
        """Forget everything and collect rollouts of `num_steps` from now on."""
        with self._changed:
            self._clear()
            self._num_steps, self._overrun, self._session, self.heard_s = num_steps, 0, 0, time.monotonic()

    def end(self) -> None:
        """Collect nothing until begin()."""
        with self._changed:
            self._clear()
            self._num_steps = 0
            self._withhold(False)

    def enter_session(self, session: int) -> None:
        """The recorded environment was restarted: its step ids start again."""
        with self._changed:
            if session != self._session:
                self._finish()
                if self._session:
                    self._images.clear()
                    self._rewards.clear()
                self._session = session

    def put_image(self, stamp_ns: int, images: UInt8Array) -> None:
        with self._changed:
            if not self.collecting:
                return
            self.heard_s = time.monotonic()
            self._images.put(stamp_ns, images)
            for group in self._open():
                group.assembler.put_image(stamp_ns, images)
            self._changed.notify_all()

    def put_transition(self, transition: Transition) -> None:
        self.enter_session(transition.session)
        with self._changed:
            if not self.collecting:
                return
            self.heard_s = time.monotonic()
            version = int(transition.policy_versions.max())
            if transition.is_reset or (self._current is not None and self._current.version != version):
                self._finish()
            if transition.is_reset:
                return
            if self._current is None:
                self._current = self._begin_group(version)
            self._current.assembler.put_transition(transition)
            self._current.steps.add(transition.step_id)
            self._current.envs = len(transition.valid)
            if len(self._done) >= MAX_WAITING:
                self._withhold(True)
            self._changed.notify_all()

    def put_rewards(self, rewards: Rewards) -> None:
        with self._changed:
            if not self.collecting:
                return
            self.heard_s = time.monotonic()
            self._rewards.append(rewards)
            for group in self._open():
                group.assembler.put_rewards(rewards)
            self._changed.notify_all()

    def finish(self) -> None:
        """The stream has ended: what is unfinished will stay so."""
        with self._changed:
            self._finish()

    def take(self, patience_s: float) -> tuple[int, Rollout | None, DroppedTransitions] | None:
        """Return the oldest rollout that has ended, with its policy version; None while there is none yet.

        A rollout of num_steps has also ended when nothing follows it for `patience_s`. One that lacks steps, images or
        rewards `patience_s` after its end is given as None, its transitions as gaps.
        """
        with self._changed:
            current, now = self._current, time.monotonic()
            if current is not None and len(current.steps) == self._num_steps and now - self.heard_s > patience_s:
                self._finish()
            if not self._done:
                return None
            group = self._done[0]
            long_enough = len(group.steps) == self._num_steps
            whole = long_enough and group.complete
            if long_enough and not whole and now - group.done_s < patience_s:
                return None
            self._done.popleft()
            lost, self._overrun = self._overrun, 0
            if len(self._done) < MAX_WAITING:
                self._withhold(False)
        if not whole:
            return group.version, None, DroppedTransitions(gap=lost + len(group.steps) * group.envs)
        _, first, last = group.span
        rollout, dropped = group.assembler.take(first, last, group.version)
        return group.version, rollout, DroppedTransitions(dropped.invalid, dropped.gap + lost, dropped.stale)

    def wait(self, seconds: float) -> None:
        """Return after the next put, or after `seconds`."""
        with self._changed:
            self._changed.wait(seconds)

    def _open(self) -> list[_Group]:
        return [*self._done, *([self._current] if self._current is not None else [])]

    def _begin_group(self, version: int) -> _Group:
        group = _Group(version)
        group.assembler.begin()
        group.assembler.enter_session(self._session)
        for stamp_ns, images in self._images.items():
            group.assembler.put_image(stamp_ns, images)
        for rewards in self._rewards:
            group.assembler.put_rewards(rewards)
        return group

    def _finish(self) -> None:
        group, self._current = self._current, None
        if group is None:
            return
        if len(self._done) >= MAX_KEPT:
            self._overrun += len(group.steps) * group.envs
            return
        group.done_s = time.monotonic()
        self._done.append(group)

    def _clear(self) -> None:
        self._images.clear()
        self._rewards.clear()
        self._done.clear()
        self._current = None
