"""Sequence numbers in the messages themselves: DDS does not report what a keep-last history overwrote."""

import time
from dataclasses import dataclass, field


def new_session() -> int:
    """Start time of a publisher in ns since the epoch; tells a restarted publisher from the one before."""
    return time.time_ns()


@dataclass
class GapTracker:
    """Counts the sequence numbers that one consumer of one topic missed.

    The first session sets the starting point: what was sent before a consumer joined is not a gap. A session that began
    after it is expected from 0. Publishers may take turns: each session goes on where it was.
    """

    session: int | None = None
    last_seq: int = -1
    received: int = 0
    lost: int = 0
    """Over all sessions."""
    repeated: int = 0
    sessions: int = 0
    gaps: list[tuple[int, int, int]] = field(default_factory=list)
    """(session, first missing seq, number of missing seqs), newest last; at most 1000 kept."""
    _last_seqs: dict[int, int] = field(default_factory=dict, repr=False)

    def observe(self, session: int, seq: int) -> int:
        """Note one message; return how many of its session were missed directly before it."""
        self.received += 1
        if session not in self._last_seqs:
            joined_late = not self._last_seqs or session < min(self._last_seqs)
            self._last_seqs[session] = seq - 1 if joined_late else -1
            self.sessions += 1
        self.session, self.last_seq = session, self._last_seqs[session]
        if seq <= self.last_seq:
            self.repeated += 1
            return 0
        missing = seq - self.last_seq - 1
        if missing:
            self.lost += missing
            self.gaps.append((session, self.last_seq + 1, missing))
            del self.gaps[:-1000]
        self.last_seq = self._last_seqs[session] = seq
        return missing
