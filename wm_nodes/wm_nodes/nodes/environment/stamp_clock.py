"""A stamp is the wall time at which an observation was made. Nothing that is computed depends on it."""

import time
from collections.abc import Callable


class StampClock:
    """Gives the stamps of one node's observations: wall time, and always later than the stamp before.

    now_ns: ns since the epoch; it may stand still or jump back.
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._now_ns, self._last_ns = now_ns, 0

    def __call__(self) -> int:
        self._last_ns = max(self._now_ns(), self._last_ns + 1)
        return self._last_ns
