"""The running episodes of N environments, whose begin and end become episode notes. No rclpy."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wm_msgs.msg import EpisodeEvent
from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.types import BoolArray, UInt64Array
from wm_nodes.ros.wire import EpisodeNote


@dataclass
class _Slot:
    """The episode of one environment."""

    episode_id: int = 0
    """Of the environment, from 1."""
    seed: int = 0
    """Of its reset."""
    running: bool = False
    """Whether it goes on."""
    aborted: bool = False
    """Ended from outside (estop, error, stop): nothing it does counts until it is reset."""
    length: int = 0
    """Steps made."""
    holds: int = 0
    """Steps in which a robot held, which are in no transition."""
    version_first: int = 0
    """Policy version of its first step."""
    version_last: int = 0
    """Policy version of its newest step."""


class RunningEpisodes:
    """Follows the episodes of N environments.

    Args:
        note: gets every begin and end.
    """

    def __init__(self, num_envs: int, max_episode_steps: int, note: Callable[[EpisodeNote], None]) -> None:
        self.behaviour = "policy"
        """Label of the notes, until a reset names another."""
        self._max_steps, self._send = max_episode_steps, note
        self._slots = [_Slot() for _ in range(num_envs)]

    @property
    def running(self) -> BoolArray:
        return np.array([slot.running for slot in self._slots])

    @property
    def aborted(self) -> BoolArray:
        return np.array([slot.aborted for slot in self._slots])

    @property
    def lengths(self) -> NDArray[np.uint32]:
        """(N,), steps made, holds not among them."""
        return np.array([slot.length for slot in self._slots], np.uint32)

    def count_hold(self) -> None:
        """Note a step in which every robot held, outside of any transition; it counts towards the limit alone."""
        for slot in self._slots:
            slot.holds += 1

    def start(self, mask: BoolArray, episode_ids: UInt64Array, seeds: UInt64Array, stamp_ns: int) -> None:
        """Episodes (N,) of these ids and seeds began where mask is True."""
        begin = EpisodeEvent.KIND_START, EpisodeEvent.OUTCOME_UNKNOWN, EpisodeEvent.REASON_NONE
        for i in np.flatnonzero(mask).tolist():
            self._slots[i] = _Slot(episode_id=int(episode_ids[i]), seed=int(seeds[i]), running=True)
            self._note(i, *begin, stamp_ns)

    def advance(self, step: LockStep, version: int) -> None:
        """Count a lock-step that a policy version made, and end what it ended."""
        for i in np.flatnonzero(step.valid).tolist():
            slot = self._slots[i]
            slot.version_first = slot.version_first if slot.length else version
            slot.version_last = version
            slot.length += 1
            if step.success[i]:
                self._end(i, EpisodeEvent.OUTCOME_SUCCESS, EpisodeEvent.REASON_TERMINAL, step.next_stamp_ns)
            elif step.truncated[i]:
                at_limit = slot.length + slot.holds >= self._max_steps
                cut = EpisodeEvent.REASON_TIME_LIMIT if at_limit else EpisodeEvent.REASON_UNCERTAINTY
                reason = EpisodeEvent.REASON_TERMINAL if step.terminated[i] else cut
                self._end(i, EpisodeEvent.OUTCOME_FAILURE, reason, step.next_stamp_ns)

    def end(self, mask: BoolArray, reason: int, stamp_ns: int, *, abort: bool = False) -> None:
        """End what runs where mask is True. abort: nothing their environments do is valid until they are reset."""
        for i in np.flatnonzero(mask & self.running).tolist() if mask.any() else ():
            self._end(i, EpisodeEvent.OUTCOME_UNKNOWN, reason, stamp_ns)
            self._slots[i].aborted = abort

    def abort_all(self, reason: int, stamp_ns: int) -> None:
        """As end(abort=True), also where nothing runs."""
        self.end(np.ones(len(self._slots), bool), reason, stamp_ns)
        for slot in self._slots:
            slot.aborted = True

    def _end(self, i: int, outcome: int, reason: int, stamp_ns: int) -> None:
        self._slots[i].running = False
        self._note(i, EpisodeEvent.KIND_END, outcome, reason, stamp_ns)

    def _note(self, i: int, kind: int, outcome: int, reason: int, stamp_ns: int) -> None:
        slot = self._slots[i]
        self._send(EpisodeNote(
            stamp_ns=stamp_ns, kind=kind, env_index=i, episode_id=slot.episode_id, seed=slot.seed,
            behaviour=self.behaviour, length=slot.length, outcome=outcome, reason=reason,
            policy_version_first=slot.version_first, policy_version_last=slot.version_last,
        ))
