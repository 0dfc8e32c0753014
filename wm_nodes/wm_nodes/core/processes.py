"""What another process of this host does, as Linux tells it in /proc."""

import os
import time
from collections.abc import Sequence
from enum import Enum
from pathlib import Path

LEAST_SHARE = 0.1
"""Share of one core from which on a process computes. Middleware threads of an idle node need about 0.01."""


def stat_fields(pid: int) -> list[str]:
    """The fields of /proc/<pid>/stat from the third, the state, on; [] where there is no such process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def used_cpu_s(fields: Sequence[str]) -> float:
    """CPU time of a process and its threads, user and system, by its stat_fields."""
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Activity(Enum):
    """What a process was seen to do."""

    GONE = "has ended"
    STOPPED = "is stopped (kill -CONT continues it)"
    BUSY = "computes"
    IDLE = "does nothing"


class ActivityWatch:
    """Tells busy processes from idle ones by the CPU time between two looks."""

    def __init__(self) -> None:
        self._seen: dict[int, tuple[float, float]] = {}

    def look(self, pid: int, now: float | None = None) -> Activity:
        """Look at a process; whether it computes is known from the second look on. now: monotonic, in s."""
        now = time.monotonic() if now is None else now
        fields = stat_fields(pid)
        if not fields:
            self._seen.pop(pid, None)
            return Activity.GONE
        state, cpu_s = fields[0], used_cpu_s(fields)
        before_s, before_cpu_s = self._seen.get(pid, (now, cpu_s))
        if now != before_s or pid not in self._seen:
            self._seen[pid] = now, cpu_s
        if state in "ZX":
            return Activity.GONE
        if state in "Tt":
            return Activity.STOPPED
        share = (cpu_s - before_cpu_s) / (now - before_s) if now > before_s else 1.0
        return Activity.BUSY if state in "RD" or share >= LEAST_SHARE else Activity.IDLE
