"""Limit of concurrent calls, and circuit breaker of an endpoint."""

import asyncio
from collections import deque
from collections.abc import Callable
from enum import Enum

RAISE_AFTER = 50
WINDOW = 20
"""Calls that a circuit breaker looks back on."""


class AdaptiveLimit:
    """A semaphore whose size follows the server: halved when it is overloaded, one more after RAISE_AFTER good answers.

    Calls that were already under way at the last halving cannot halve again: 32 answers 429 to one burst are one sign
    of overload, not 32.
    """

    def __init__(self, maximum: int = 32) -> None:
        if maximum < 1:
            raise ValueError(f"maximum must be >= 1, got {maximum}")
        self.limit = maximum
        self.in_flight = 0
        self._maximum, self._good = maximum, 0
        self._halvings = 0
        self._freed = asyncio.Condition()

    async def acquire(self) -> int:
        """Wait for a free place; return the ticket that `overloaded` wants."""
        async with self._freed:
            await self._freed.wait_for(lambda: self.in_flight < self.limit)
            self.in_flight += 1
            return self._halvings

    async def release(self) -> None:
        self.in_flight -= 1
        async with self._freed:
            self._freed.notify_all()

    def record_overload(self, ticket: int) -> None:
        """Halve the limit, unless it was halved since the call with this ticket began."""
        if ticket == self._halvings:
            self._halvings += 1
            self._good = 0
            self.limit = max(1, self.limit // 2)

    def record_success(self) -> None:
        self._good += 1
        if self._good >= RAISE_AFTER:
            self._good = 0
            self.limit = min(self._maximum, self.limit + 1)


class Admission(Enum):
    """What a circuit breaker answers to a call that wants to begin."""

    YES = "yes"
    PROBE = "probe"
    NO = "no"


class CircuitBreaker:
    """Opens when more than half of the last WINDOW calls failed; then lets one probe through every `probe_s` seconds.

    A probe that succeeds closes it and forgets the failures. A probe that is never reported (its caller was cancelled)
    costs one `probe_s` and nothing more.

    Args:
        now: a monotonic clock, s.
    """

    def __init__(self, now: Callable[[], float], *, probe_s: float = 10.0) -> None:
        if not probe_s > 0:
            raise ValueError(f"probe_s must be > 0, got {probe_s}")
        self._now, self._probe_s = now, probe_s
        self._failed: deque[bool] = deque(maxlen=WINDOW)
        self._next_probe: float | None = None

    @property
    def is_open(self) -> bool:
        return self._next_probe is not None

    def admit(self) -> Admission:
        """Whether a call may begin now; the answer belongs into `record`."""
        if self._next_probe is None:
            return Admission.YES
        if self._now() < self._next_probe:
            return Admission.NO
        self._next_probe = self._now() + self._probe_s
        return Admission.PROBE

    def record(self, admission: Admission, *, failed: bool) -> None:
        """Count one ended call. Calls that began before the breaker opened do not close it."""
        if self.is_open:
            if admission is Admission.PROBE and not failed:
                self._next_probe = None
                self._failed.clear()
            return
        self._failed.append(failed)
        if len(self._failed) == self._failed.maxlen and 2 * sum(self._failed) > len(self._failed):
            self._next_probe = self._now() + self._probe_s
