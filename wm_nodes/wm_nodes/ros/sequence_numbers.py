"""Sequence numbers in the messages themselves: DDS does not report what a keep-last history overwrote."""

import time
from dataclasses import dataclass, field

from wm_msgs.msg import ErrorCode
from wm_nodes.core.errors import WireError

MAX_NUMBER = 2**64 - 1
"""Largest value of the fields session and seq."""

MAX_GAP = 2**16
"""One message that jumps by more is no number at all: no history and no credit window is as long, and a restart of the
sender begins another session."""
BACK_RUN = 8
"""Messages one after the other, lower than before, by which a player shows that it went back."""

SESSIONS_KEPT = 64

CLOCKS_APART_NS = 3600 * 10**9
"""How far the clocks of two hosts may be apart."""


def new_session() -> int:
    """Start time of a publisher in ns since the epoch; tells a restarted publisher from the one before."""
    return time.time_ns()


def check_session(session: int, known: int = 0) -> None:
    """Refuse what cannot come from the publisher whose `known` session was announced, nor from its restart.

    Raises:
        WireError: OUT_OF_ORDER for a session that lies in the future, or before `known`.
    """
    if session != known and not known < session <= time.time_ns() + CLOCKS_APART_NS:
        raise WireError(
            ErrorCode.OUT_OF_ORDER,
            f"session {session} is neither the announced {known} nor a later start; is a second publisher there, or a "
            "clock wrong?",
        )


@dataclass
class GapTracker:
    """Counts the sequence numbers that one consumer of one topic missed.

    The first session sets the starting point: what was sent before a consumer joined is not a gap. A session that began
    after it is expected from 0. Publishers may take turns: each session goes on where it was. Where a player goes back,
    the numbers go on from there.
    """

    session: int | None = None
    """Of the newest message; None before any."""
    last_seq: int = -1
    """Of that session; a jump is believed when the next message goes on from there, a way back after BACK_RUN ones: it
    takes back what was granted, and a stray old message must not hold a producer up."""
    received: int = 0
    """Messages of all sessions."""
    lost: int = 0
    """Over all sessions."""
    jumps: int = 0
    """Forward by more than MAX_GAP."""
    gaps: list[tuple[int, int, int]] = field(default_factory=list)
    """(session, first missing seq, number of missing seqs), newest last; at most 1000 kept."""
    _last_seqs: dict[int, int] = field(default_factory=dict, repr=False)
    """Newest number of each session."""
    _jumped_to: tuple[int, int] | None = field(default=None, repr=False)
    """The newest message of a jump or a way back."""
    _run: int = field(default=0, repr=False)
    """How many came one after the other up to that one."""

    def observe(self, session: int, seq: int) -> int:
        """Note one message; return how many of its session were missed directly before it."""
        self.received += 1
        if session not in self._last_seqs:
            joined_late = not self._last_seqs or session < min(self._last_seqs)
            self._last_seqs[session] = seq - 1 if joined_late else -1
            if len(self._last_seqs) > SESSIONS_KEPT:
                del self._last_seqs[next(iter(self._last_seqs))]
        self._last_seqs[session] = self._last_seqs.pop(session)  # the newest last, so that it stays longest
        self.session, self.last_seq = session, self._last_seqs[session]
        missing = seq - self.last_seq - 1
        if not 0 <= missing <= MAX_GAP:
            self.jumps += missing > 0
            goes_on, self._jumped_to = self._jumped_to == (session, seq - 1), (session, seq)
            self._run = self._run + 1 if goes_on else 1
            if self._run < (2 if missing > 0 else BACK_RUN):
                return 0
            missing = 0
        self._jumped_to = None
        if missing:
            self.lost += missing
            self.gaps.append((session, self.last_seq + 1, missing))
            del self.gaps[:-1000]
        self.last_seq = self._last_seqs[session] = seq
        return missing

    def clear_losses(self) -> None:
        """Count what is lost anew."""
        self.lost, self.gaps = 0, []
