"""Play a bag in its own time: rate, pause, seek, single steps, loop. No rclpy; the caller publishes."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError

NS_PER_S = 1_000_000_000
CLOCK_PERIOD_S = 0.025
"""The clock ticks at least this often while playing, s of wall time."""

Publish = Callable[[str, bytes], None]


class Playback:
    """One pass (or endless ones) over a bag. run() plays in the calling thread; every other method is thread-safe.

    Args:
        names: absolute topics to play; empty plays all.
        rate: recorded seconds per second, > 0.
        start_offset_s: where to begin, s from the first message.

    Raises:
        BagError: an unusable bag, a topic it does not hold, or a rate or offset out of range.
    """

    def __init__(
        self, path: Path, *, names: Sequence[str] = (), rate: float = 1.0, start_offset_s: float = 0.0,
        loop: bool = False, paused: bool = False,
    ) -> None:
        self._path, self._names, self._loop = path, list(names), loop
        with Bag(path) as bag:
            self.topics = {c.topic: c for c in bag.connections if not names or c.topic in names}
            self.start_ns, self.end_ns = bag.start_ns, bag.end_ns
            missing = sorted(set(names) - {c.topic for c in bag.connections})
            if missing:
                recorded = ", ".join(sorted(c.topic for c in bag.connections))
                raise BagError(f"bag {path} has no topic {', '.join(missing)}; it holds {recorded}")
        self._condition = threading.Condition()
        self._paused, self._steps, self._stopped = paused, 0, False
        self._seek_ns: int | None = None
        self._rate = 1.0
        self._anchor: tuple[float, int] = (time.monotonic(), self.start_ns)
        self._position_ns = self.start_ns
        self.messages = 0
        self.set_rate(rate)
        self.seek(start_offset_s)

    @property
    def duration_s(self) -> float:
        return max(0, self.end_ns - self.start_ns) / NS_PER_S

    @property
    def position_s(self) -> float:
        """Time of the newest published message or clock tick, s from the first message."""
        return (self._position_ns - self.start_ns) / NS_PER_S

    @property
    def paused(self) -> bool:
        return self._paused

    def pause(self) -> None:
        with self._condition:
            self._paused = True
            self._condition.notify_all()

    def resume(self) -> None:
        with self._condition:
            self._paused, self._steps = False, 0
            self._anchor = time.monotonic(), self._position_ns
            self._condition.notify_all()

    def set_rate(self, rate: float) -> None:
        """Raises BagError for a rate that is not above 0."""
        if not 0 < rate < float("inf"):
            raise BagError(f"rate must be above 0, got {rate}; 1.0 plays as recorded")
        with self._condition:
            self._anchor = time.monotonic(), self._position_ns
            self._rate = rate
            self._condition.notify_all()

    def seek(self, position_s: float) -> None:
        """Go on from `position_s` after the first message. Raises BagError outside the bag."""
        if not 0 <= position_s <= self.duration_s:
            raise BagError(f"position {position_s} s lies outside the bag, which lasts {self.duration_s:.3f} s")
        with self._condition:
            self._seek_ns = self.start_ns + round(position_s * NS_PER_S)
            self._condition.notify_all()

    def play_next(self, count: int, timeout_s: float = 2.0) -> int:
        """While paused, publish the next `count` messages; return how many were within timeout_s."""
        with self._condition:
            if not self._paused:
                raise BagError("playing; pause before playing single messages")
            before = self.messages
            self._steps = count
            self._condition.notify_all()
            self._condition.wait_for(lambda: self._steps == 0 or self._stopped, timeout_s)
            self._steps = 0
            return self.messages - before

    def stop(self) -> None:
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def run(self, publish: Publish, tick: Callable[[int], None], check: Callable[[], None] = lambda: None) -> None:
        """Play to the end, or until stop(), or until check() raises.

        Args:
            publish: gets (absolute topic, CDR bytes).
            tick: gets the bag's time, ns, before each message and every CLOCK_PERIOD_S.
            check: called many times a second.
        """
        try:
            with Bag(self._path) as bag:
                while not self._stopped:
                    start_ns = self._take_seek()
                    ended = self._play_from(bag, start_ns, publish, tick, check)
                    if ended and not self._loop:
                        return
                    if ended:
                        self._restart()
        finally:
            self.stop()

    def _play_from(
        self, bag: Bag, start_ns: int, publish: Publish, tick: Callable[[int], None], check: Callable[[], None]
    ) -> bool:
        """Return True at the end of the bag, False when another position was asked for or playing was stopped."""
        for name, time_ns, data in bag.messages(self._names, start_ns=start_ns):
            if not self._wait_for(time_ns, tick, check):
                return False
            tick(time_ns)
            publish(name, data)
            with self._condition:
                self.messages += 1
                self._steps = max(0, self._steps - 1)
                self._position_ns = time_ns
                self._condition.notify_all()
        return True

    def _take_seek(self) -> int:
        with self._condition:
            start_ns = self._seek_ns if self._seek_ns is not None else self._position_ns
            self._seek_ns, self._position_ns = None, start_ns
            self._anchor = time.monotonic(), start_ns
            return start_ns

    def _restart(self) -> None:
        with self._condition:
            if self._seek_ns is None:
                self._seek_ns = self.start_ns

    def _wait_for(self, time_ns: int, tick: Callable[[int], None], check: Callable[[], None]) -> bool:
        """Wait until a message is due; False: play from elsewhere, or not at all."""
        while True:
            check()
            with self._condition:
                if self._stopped or self._seek_ns is not None:
                    return False
                if self._paused and not self._steps:
                    self._condition.wait(CLOCK_PERIOD_S)
                    continue
                began_s, began_ns = self._anchor
                now_ns = began_ns + round((time.monotonic() - began_s) * self._rate * NS_PER_S)
                if self._paused or now_ns >= time_ns:
                    return True
                self._condition.wait(min(CLOCK_PERIOD_S, (time_ns - now_ns) / NS_PER_S / self._rate))
                if self._paused or self._seek_ns is not None:
                    continue
                began_s, began_ns = self._anchor
                now_ns = began_ns + round((time.monotonic() - began_s) * self._rate * NS_PER_S)
                self._position_ns = min(time_ns, max(self._position_ns, now_ns))
                position_ns = self._position_ns
            tick(position_ns)
