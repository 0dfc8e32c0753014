"""The samples of each topic of a contract in one bag: times on one clock, numbers and texts, but no pictures.

Shapes: n samples of a topic, D values.
"""

from array import array
from difflib import get_close_matches
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.progress import tqdm
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.imported.contract import IMAGE, STRING, Camera, Contract, Numbers, Source
from wm_nodes.recording.imported.numbers import Selector
from wm_nodes.recording.imported.pictures import DamagedPictureError, check_encoding, kept_part, rgb_of
from wm_nodes.recording.messages import NS_PER_S, stamp_ns
from wm_nodes.recording.typestore import is_known, typestore

Times = NDArray[np.int64]
SAMPLED = ("images", "state", "actions", "probes")
"""Places in the contract that have a sample at every step."""
FEWEST_PICTURES = 0.8
"""Pictures per step, below which a camera is too slow for rate_hz."""
MAX_CLOCK_OFFSET_MS = 500
"""Of two topics, where the contract says nothing."""
SET_BACK_NS = NS_PER_S
"""Stamps that fall by more come from a clock that was set back, or from a second run."""


class Stream:
    """One topic's samples, gathered message by message, then sorted by `finish`.

    place: in the contract. clock: header or receive. skipped: messages that are no sample. sizes: (H, W) of pictures.
    times: (n,) int64 ns on its clock, rising. offsets_ns: (n,), received less stamped. values: (n, D), or (n, 0).
    numbers: (n,) the place of each sample's message among those of its topic.
    """

    def __init__(self, place: str, source: Source, contract: Contract) -> None:
        self.place, self.source = place, source
        self.has_header = any(name == "header" for name, _ in typestore().fielddefs[source.type][1])
        asked = source.timeline or contract.timeline
        if source.timeline == "header" and not self.has_header:
            raise BagError(f"{place}: {source.type} has no header; set its timeline to receive")
        self.clock = asked if self.has_header else "receive"
        self.skipped, self.sizes, self.texts = 0, set[tuple[int, int]](), list[str]()
        self._select = Selector(source.type, source.select if isinstance(source, Numbers) else ["data"])
        self._received, self._stamped, self._numbers, self._values = array("q"), array("q"), array("q"), array("d")
        self._count = 0

    def add(self, message: Any, received_ns: int) -> None:
        """Take a message as a sample, unless it lacks what is selected. Raises BagError: it can never be one."""
        number, self._count = self._count, self._count + 1
        try:
            sample = self._sample(message)
        except DamagedPictureError:
            sample = None
        if sample is None:
            self.skipped += 1
            return
        self._values.extend(sample)
        self._numbers.append(number)
        self._received.append(received_ns)
        self._stamped.append(stamp_ns(message.header.stamp) if self.has_header else received_ns)

    def _sample(self, message: Any) -> list[float] | None:
        if isinstance(self.source, Camera):
            if self.source.type == IMAGE or self.sizes:  # of compressed pictures, one is decoded for its size
                check_encoding(message)
                self.sizes |= {(message.height, message.width)} if self.source.type == IMAGE else set()
            else:
                height, width, _ = rgb_of(message).shape
                self.sizes.add((height, width))
            return []
        if self.source.type == STRING:
            self.texts.append(message.data)
            return []
        return self._select(message)

    def finish(self) -> None:
        """Sort the samples by their clock."""
        received, stamped = np.array(self._received, np.int64), np.array(self._stamped, np.int64)
        times = stamped if self.clock == "header" else received
        order = np.argsort(times, kind="stable")
        self.set_back_ns = int(-np.diff(times).min(initial=0))
        self.unstamped = bool(len(stamped)) and not stamped.all()
        self.times, self.offsets_ns = times[order], (received - stamped)[order]
        self.numbers = np.array(self._numbers, np.int64)[order]
        self.values = np.array(self._values, np.float64).reshape(len(times), -1 if len(times) else 0)[order]
        self.texts = [self.texts[row] for row in order] if self.texts else []

    @property
    def rate_hz(self) -> float:
        """By the median distance of samples; NaN for fewer than two."""
        distances = np.diff(self.times)
        return float(NS_PER_S / max(np.median(distances), 1)) if len(distances) else np.nan

    @property
    def offset_ms(self) -> float:
        """Median of received less stamped."""
        return float(np.median(self.offsets_ns)) / 1e6 if len(self.times) else 0.0

    def newest(self, ticks: Times) -> Times:
        """(K,) the sample at or before each tick; -1: none."""
        return np.searchsorted(self.times, ticks, side="right") - 1

    def integral(self, until: Times) -> NDArray[np.float64]:
        """(K, D) values times ns, from the first sample until each time, while each sample holds until the next."""
        newest = np.maximum(self.newest(until), 0)
        return np.asarray(self._sums[newest] + self.values[newest] * (until - self.times[newest])[:, None])

    @cached_property
    def _sums(self) -> NDArray[np.float64]:
        """(n, D), integral(times)."""
        held = self.values[:-1] * np.diff(self.times)[:, None]
        return np.concatenate([np.zeros((1, self.values.shape[1])), held.cumsum(0)])

    def problems(self, contract: Contract) -> list[str]:
        """What makes it useless, with the remedies."""
        name, max_age_ns = f"{self.place}: {self.source.topic}", contract.max_age_ns(self.source)
        if not len(self.times) and self.place == "success" and not self.skipped:
            return []  # a bag in which nothing succeeded
        if not len(self.times):
            joints = f", and the last one names {', '.join(self._select.joints)}" if self._select.joints else ""
            asked = f" with {', '.join(self._select.select)}" if isinstance(self.source, Numbers) else ""
            return [f"{name} has no usable message{asked} ({self.skipped} others{joints}); mend the contract, or leave "
                    "this bag out"]
        texts = list[str]()
        if self.clock == "header" and self.unstamped:
            texts.append(f"{name} has header stamps of 0; set its timeline to receive")
        elif self.set_back_ns > SET_BACK_NS:
            texts.append(f"{name} has stamps that fall by {self.set_back_ns / NS_PER_S:.1f} s; set its timeline to "
                         "receive, or record each run in a bag of its own")
        is_stream = self.place.startswith(SAMPLED)
        if is_stream and self.rate_hz < NS_PER_S / max_age_ns:
            texts.append(f"{name} comes with {self.rate_hz:.3g} Hz, and max_age_ms {max_age_ns / 1e6:g} asks for "
                         f"{NS_PER_S / max_age_ns:.3g}; raise its max_age_ms, or publish it faster")
        elif isinstance(self.source, Camera) and self.rate_hz < FEWEST_PICTURES * contract.rate_hz:
            texts.append(f"{name} comes with {self.rate_hz:.3g} Hz, less than rate_hz {contract.rate_hz:g}: pictures "
                         "would repeat; lower rate_hz")
        if isinstance(self.source, Camera):
            if len(self.sizes) > 1:
                texts.append(f"{name} has pictures of {sorted(self.sizes)} px; import bags of one size at a time")
            try:
                kept_part(*min(self.sizes), self.source)
            except BagError as error:
                texts.append(f"{name}: {error}")
        return texts


def check_topics(bag: Bag, contract: Contract) -> None:
    """Raise BagError that names every topic of the contract that is missing, or has another type, in the bag."""
    types, wrong = {connection.topic: connection.msgtype for connection in bag.connections}, list[str]()
    for place, source in contract.sources().items():
        recorded = types.get(source.topic)
        if place == "success" and recorded in (None, source.type):
            continue  # maybe nothing succeeded in this bag
        if recorded is None or not bag.count(source.topic):
            same = [topic for topic, msgtype in types.items() if msgtype == source.type and bag.count(topic)]
            close = get_close_matches(source.topic, same, n=3, cutoff=0) or ["none"]
            wrong.append(f"{place}: no message on {source.topic}; topics of {source.type}: {', '.join(close)}")
        elif (serialization := bag.serialization(source.topic)) != "cdr":
            wrong.append(f"{place}: {source.topic} holds {serialization} messages, and ROS 2 writes cdr; of a bag of "
                         "ROS 1, run `rosbags-convert --src BAG.bag --dst FOLDER` on the original, and import FOLDER")
        elif recorded != source.type:
            wrong.append(f"{place}: {source.topic} is of {recorded}, not {source.type}; correct its type")
        elif not is_known(source.type):
            wrong.append(f"{place}: {source.type} is not one of ROS 2 Jazzy's common types; republish it as one")
        elif (fall_ns := bag.set_back_ns(source.topic)) > SET_BACK_NS:
            wrong.append(f"{place}: a clock was set back by {fall_ns / NS_PER_S:.1f} s while {source.topic} was "
                         "recorded, so that two times would mix; leave this bag out, or cut it there")
    if wrong:
        raise BagError(f"bag {bag.path} does not fit the contract: {'; '.join(wrong)}")
    bag.check_types([source.topic for source in contract.sources().values()])


def read_streams(bag: Bag, contract: Contract) -> dict[str, Stream]:
    """Read a bag once; returns the topics by their places in the contract.

    Raises:
        BagError: names everything in which the topics do not fit the contract, with the remedies.
    """
    streams = {place: Stream(place, source, contract) for place, source in contract.sources().items()}
    by_topic: dict[str, list[Stream]] = {stream.source.topic: [] for stream in streams.values()}
    for stream in streams.values():
        by_topic[stream.source.topic].append(stream)
    total = sum(map(bag.count, by_topic))
    for topic, received_ns, data in tqdm(bag.messages(by_topic), f"{bag.path.name}: topics", total):
        message = bag.decode(data, by_topic[topic][0].source.type)
        for stream in by_topic[topic]:
            try:
                stream.add(message, received_ns)
            except BagError as error:
                raise BagError(f"bag {bag.path}: {stream.place}: {topic}: {error}") from None
    problems = list[str]()
    for stream in streams.values():
        stream.finish()
        problems += stream.problems(contract)
    if problems := problems or _clock_problems(list(streams.values()), contract):
        raise BagError(f"bag {bag.path} does not fit the contract: {'; '.join(problems)}")
    return streams


def _clock_problems(streams: list[Stream], contract: Contract) -> list[str]:
    """Clocks that lie further apart than the contract allows.

    A camera may be stamped long before its picture is received. Where every stamp is, the recorder was behind, and
    topics that count from their reception come that much too late.
    """
    stamped = {stream.place: stream.offset_ms for stream in streams if stream.clock == "header"}
    received = [stream.place for stream in streams if stream.clock == "receive" and len(stream.times)]
    if stamped and received and contract.max_clock_offset_ms is None:
        nearest = min(stamped, key=lambda place: abs(stamped[place]))
        if abs(stamped[nearest]) > (half_ms := contract.period_ns / 2e6):
            return [f"{', '.join(received)} count from their reception, which is {stamped[nearest]:.0f} ms after the "
                    f"stamps of {nearest}, more than half a step of rate_hz, {half_ms:g} ms; set timeline: receive, or "
                    "max_clock_offset_ms to what is right"]
    offsets = {stream.place: 0.0 for stream in streams} | stamped
    limit_ms = contract.max_clock_offset_ms or MAX_CLOCK_OFFSET_MS
    first, last = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
    apart = offsets[last] - offsets[first]
    if apart <= limit_ms:
        return []
    return [f"the clocks of {first} and {last} lie {apart:.0f} ms apart, and max_clock_offset_ms is "
            f"{limit_ms:g}; set timeline to receive, or synchronise the clocks and record again"]
