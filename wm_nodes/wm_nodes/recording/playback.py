"""Play a bag in its own time: rate, pause, seek, single steps, loop. No rclpy; the caller publishes."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosDurability, QosHistory

from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.messages import NS_PER_S

CLOCK_PERIOD_S = 0.025
"""The clock ticks at least this often while playing, s of wall time; a loop begins again at most this often."""

GAP_S = 86_400
"""Recorded time that is not waited for: in a gap of a day the recorder's clock was set, s."""

STEP_S = 0.1
"""How far messages may be out of order before the recorder's clock was set back (ntpd sets it from 0.128 s on), s."""

LONG_WAIT_S = 5.0
"""A wait for the next message that is announced, s of wall time."""

STATIC_TRANSFORMS = "/tf_static"
Publish = Callable[[str, bytes], None]
Say = Callable[[str], None]


class Playback:
    """One pass (or endless ones) over a bag. run() plays in the calling thread; every other method is thread-safe.

    Args:
        names: absolute topics to play; empty plays all.
        rate: recorded seconds per second, > 0.
        start_offset_s: where to begin, s from the first message.

    damaged: parts of the bag that could not be read and were left out. messages: published so far; latched ones of
    before the position that playing began at, which are published first, are not counted.

    Raises:
        BagError: an unusable bag, a topic it does not hold, no message to play in a loop, or a rate or offset out of
            range.
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
            if loop and not any(bag.count(name) for name in self.topics):
                names = sorted(self.topics) or ["any topic"]
                raise BagError(f"bag {path} has no message on {', '.join(names)} to play in a loop")
        self._condition = threading.Condition()
        self._paused, self._steps, self._stopped = paused, 0, False
        self._seek_ns: int | None = None
        self._rate = 1.0
        self._anchor: tuple[float, int] = (time.monotonic(), self.start_ns)
        self._position_ns = self.start_ns
        self._taken, self._is_held_back = 0, False
        """Messages handed to publish(), and whether it holds the newest of them back."""
        self.messages = 0
        self.damaged: list[str] = []
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
        """While paused, publish the next `count` messages; return how many were within timeout_s, or until one was held
        back: that one counts, as it leaves sooner or later."""
        with self._condition:
            if not self._paused:
                raise BagError("playing; pause before playing single messages")
            before = self._taken
            self._steps = count
            self._condition.notify_all()
            self._condition.wait_for(
                lambda: self._is_held_back or self._stopped or (not self._steps and self.messages == self._taken),
                timeout_s,
            )
            self._steps = 0
            return self._taken - before

    @contextmanager
    def held_back(self) -> Iterator[None]:
        """For publish(): while it waits before it publishes, nobody else waits for it in play_next()."""
        self._set_held_back(True)
        try:
            yield
        finally:
            self._set_held_back(False)

    def _set_held_back(self, is_held_back: bool) -> None:
        with self._condition:
            self._is_held_back = is_held_back
            self._condition.notify_all()

    @property
    def stopped(self) -> bool:
        return self._stopped

    def stop(self) -> None:
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def run(
        self, publish: Publish, tick: Callable[[int], None], check: Callable[[], None] = lambda: None,
        say: Say = lambda text: None, begin: Callable[[], object] = lambda: None,
    ) -> None:
        """Play to the end, or until stop(), or until check() raises.

        Args:
            publish: gets (absolute topic, CDR bytes).
            tick: gets the bag's time, ns, before each message and every CLOCK_PERIOD_S.
            check: called many times a second.
            say: gets a sentence for each damaged part, long wait and jump of the recorder's clock.
            begin: called before the first message of each pass, and before the first one after a seek.
        """
        try:
            with Bag(self._path) as bag:
                while not self._stopped:
                    start_ns = self._take_seek()
                    begin()
                    ended = self._play_from(bag, start_ns, publish, tick, check, say)
                    if ended and not (self._loop and (self.messages or start_ns > self.start_ns)):
                        return
                    if ended:
                        self._restart(check)
        finally:
            self.stop()

    def _play_from(
        self, bag: Bag, start_ns: int, publish: Publish, tick: Callable[[int], None], check: Callable[[], None],
        say: Say,
    ) -> bool:
        """Return True at the end of the bag, False when another position was asked for or playing was stopped."""
        for name, data in self._latched_before(bag, start_ns, check):
            tick(start_ns)
            publish(name, data)
        damaged: list[str] = []
        messages = bag.messages(self._names, start_ns=start_ns, damaged=damaged)
        for number, (name, time_ns, data) in enumerate(messages):
            self._note_damage(damaged, say)
            self._follow_clock(time_ns, say, is_start=number == 0 and bag.in_file_order)
            if not self._wait_for(time_ns, tick, check, say):
                return False
            tick(time_ns)
            with self._condition:
                self._taken += 1
                self._steps = max(0, self._steps - 1)
            publish(name, data)
            with self._condition:
                self.messages += 1
                self._position_ns = time_ns
                self._condition.notify_all()
        self._note_damage(damaged, say)
        return True

    def _latched_before(self, bag: Bag, start_ns: int, check: Callable[[], None]) -> Iterator[tuple[str, bytes]]:
        """What a reader that came at start_ns would have got of the latched topics, in the order of the recording."""
        kept = {name: deque[tuple[int, bytes]](maxlen=_depth(topic)) for name, topic in self.topics.items()}
        kept = {name: queue for name, queue in kept.items() if queue.maxlen != 0 and bag.count(name)}
        if start_ns <= self.start_ns or not kept:
            return
        for number, (name, time_ns, data) in enumerate(bag.messages(kept, damaged=[])):
            check()
            if time_ns >= start_ns:
                break
            kept[name].append((number, data))
        for _, name, data in sorted((number, name, data) for name, queue in kept.items() for number, data in queue):
            yield name, data

    def _note_damage(self, damaged: list[str], say: Say) -> None:
        for part in damaged:
            if part not in self.damaged:
                self.damaged.append(part)
                say(f"bag {self._path} is damaged, and this part is left out: {part}")
        damaged.clear()

    def _follow_clock(self, time_ns: int, say: Say, *, is_start: bool) -> None:
        """Go on at once with a message before which the recorder's clock was set back, or forward by days."""
        with self._condition:
            gap_s = (time_ns - self._position_ns) / NS_PER_S
            if self._seek_ns is not None or (-STEP_S <= gap_s < GAP_S and not is_start):
                return
            self._anchor, self._position_ns = (time.monotonic(), time_ns), time_ns
        if not is_start:
            way = "on" if gap_s > 0 else "back"
            say(f"the bag's time goes {way} by {abs(gap_s):.0f} s here, which is not waited for")

    def _take_seek(self) -> int:
        with self._condition:
            start_ns = self._seek_ns if self._seek_ns is not None else self._position_ns
            self._seek_ns, self._position_ns = None, start_ns
            self._anchor = time.monotonic(), start_ns
            return start_ns

    def _restart(self, check: Callable[[], None]) -> None:
        check()
        with self._condition:
            self._condition.wait_for(lambda: self._stopped or self._seek_ns is not None, CLOCK_PERIOD_S)
            if self._seek_ns is None:
                self._seek_ns = self.start_ns

    def _now_ns(self) -> int:
        """The bag's time now, while it plays."""
        began_s, began_ns = self._anchor
        return began_ns + round((time.monotonic() - began_s) * self._rate * NS_PER_S)

    def _wait_for(self, time_ns: int, tick: Callable[[int], None], check: Callable[[], None], say: Say) -> bool:
        """Wait until a message is due; False: play from elsewhere, or not at all."""
        is_said = False
        while True:
            check()
            with self._condition:
                if self._stopped or self._seek_ns is not None:
                    return False
                if self._paused and not self._steps:
                    self._condition.wait(CLOCK_PERIOD_S)
                    continue
                now_ns = self._now_ns()
                if self._paused or now_ns >= time_ns:
                    return True
                wait_s = (time_ns - now_ns) / NS_PER_S / self._rate
                position_s = (time_ns - self.start_ns) / NS_PER_S
                self._condition.wait(min(CLOCK_PERIOD_S, wait_s))
                if self._paused or self._seek_ns is not None:
                    continue
                self._position_ns = min(time_ns, max(self._position_ns, self._now_ns()))
                position_ns = self._position_ns
            if wait_s > LONG_WAIT_S and not is_said:
                is_said = True
                say(f"the next message is at {position_s:.3f} s of the bag, due in {wait_s:.0f} s; seek to go on now")
            tick(position_ns)


def _depth(topic: Connection) -> int | None:
    """How many messages of a topic its recorded publishers keep for readers that come later; None: all."""
    assert isinstance(topic.ext, ConnectionExtRosbag2)
    latched = [qos for qos in topic.ext.offered_qos_profiles if qos.durability is QosDurability.TRANSIENT_LOCAL]
    if latched and topic.topic.endswith(STATIC_TRANSFORMS):
        return None  # they add up, from however many publishers
    if any(qos.history is QosHistory.KEEP_ALL for qos in latched):
        return None
    return sum(max(qos.depth, 1) for qos in latched)
