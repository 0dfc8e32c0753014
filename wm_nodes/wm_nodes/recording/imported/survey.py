"""What bags hold that a contract reads, as a table and as planned episodes: before anything is written."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.imported.contract import Contract
from wm_nodes.recording.imported.planning import PlannedEpisode, Planner, Tally
from wm_nodes.recording.imported.streams import Stream, check_topics, read_streams

ROS_1 = ".bag"


@dataclass
class TopicRow:
    """One topic of the contract, over all bags."""

    topic: str
    """Its name."""
    clock: str
    """header or receive."""
    messages: int = 0
    """Samples."""
    unusable: int = 0
    """Messages that are no sample."""
    rate_hz: float = np.inf
    """Of the slowest bag."""
    offset_ms: float = 0.0
    """Received less stamped, the median of the bag in which it is largest."""

    def add(self, stream: Stream) -> None:
        self.messages += len(stream.times)
        self.unusable += stream.skipped
        self.rate_hz = np.fmin(self.rate_hz, stream.rate_hz)
        self.offset_ms = max(self.offset_ms, stream.offset_ms, key=abs)


@dataclass
class Survey:
    """The bags of one import."""

    contract: Contract
    """What was read of them."""
    topics: dict[str, TopicRow] = field(default_factory=dict)
    """By place in the contract."""
    tally: Tally = field(default_factory=Tally)
    """What was counted."""
    planned: dict[Path, list[PlannedEpisode]] = field(default_factory=dict)
    """The episodes of each bag."""

    @property
    def episodes(self) -> list[PlannedEpisode]:
        return [episode for planned in self.planned.values() for episode in planned]

    def table(self) -> str:
        """What somebody must see before training on it."""
        contract, tally, episodes = self.contract, self.tally, self.episodes
        header = ("place", "topic", "clock", "messages", "unusable", "Hz", "largest gap in an episode", "ticks without",
                  "received later by")
        rows = [
            (place, row.topic, row.clock, str(row.messages), str(row.unusable),
             f"{row.rate_hz:.1f}" if np.isfinite(row.rate_hz) else "-", _gap(tally.gaps.get(place)),
             f"{tally.missing[place] / tally.ticks:.1%}" if place in tally.gaps else "-",
             f"{row.offset_ms:.0f} ms" if row.offset_ms or row.clock == "header" else "-")
            for place, row in self.topics.items()
        ]
        boxes = {name: (low, high, unit) for source in contract.actions for name, low, high, unit in zip(
            source.value_names, source.low, source.high, [source.unit] * len(source.select))}
        commands = [
            (name, f"{boxes[name][0]:g} to {boxes[name][1]:g} {boxes[name][2]}", f"{low:.4g} to {high:.4g}",
             f"{tally.beyond[name]} ({tally.beyond[name] / tally.steps:.1%})")
            for name, (low, high) in tally.commanded.items()
        ]
        tries = len({episode.try_number for episode in episodes})
        of_tries = f" of {tries} tries" if tries < len(episodes) else ""
        successes = sum(bool(episode.success[-1]) for episode in episodes)
        lines = [
            *_aligned([header, *rows]), "",
            *_aligned([("command", "limits", "in the steps", "steps beyond"), *commands]), "",
            f"bags: {len(self.planned)}; episodes: {len(episodes)}{of_tries}, {successes} of them end in "
            f"success; steps: {tally.steps} of {contract.period_ns / 1e6:g} ms",
            *(f"left out: {count} steps {reason}" for reason, count in tally.lost.items() if count),
            *(f"left out: {count} stretches {reason}" for reason, count in tally.lost_episodes.items()),
        ]
        if tally.unlabelled:
            lines.append(f"failures, as no message says more: {tally.unlabelled} recorded episodes")
        return "\n".join(lines)

    def check(self) -> None:
        """Raise BagError where there is nothing to write, no success topic, or commands beyond the limits."""
        success = self.topics.get("success")
        if success is not None and not success.messages:
            raise BagError(f"success: no message on {success.topic} in any bag; correct the topic, or label the "
                           "episodes in a file")
        if not self.episodes:
            reasons = Counter(self.tally.lost) + self.tally.lost_episodes
            raise BagError(f"no episode in {', '.join(map(str, self.planned))}: "
                           f"{', '.join(reasons) or 'episodes.split cuts out nothing'}; mend episodes or max_age_ms")
        beyond = {name: self.tally.commanded[name] for name, count in self.tally.beyond.items() if count}
        if beyond and self.contract.beyond_limits == "refuse":
            texts = [f"{name} from {low:.4g} to {high:.4g}" for name, (low, high) in beyond.items()]
            raise BagError(f"commands leave the limits: {', '.join(texts)}; widen low and high, or set beyond_limits: "
                           "clip")


def survey(paths: Sequence[Path], contract: Contract) -> Survey:
    """Read the numbers of all bags and plan their episodes; the numbers of one bag are in memory at a time.

    A bag is opened to be checked, to be read, and to be written: of compressed ones one lies unpacked at a time.

    Raises:
        BagError: names what does not fit the contract, with the remedies.
    """
    result, paths = Survey(contract), _distinct(paths, contract.episodes.success.file)
    for path in paths:
        if path.suffix == ROS_1:
            raise BagError(f"{path} is a bag of ROS 1; run `rosbags-convert --src {path} --dst {path.with_suffix('')}`"
                           ", and import what it writes")
        with Bag(path) as bag:
            check_topics(bag, contract)
    for path in paths:
        with Bag(path) as bag:
            streams = read_streams(bag, contract)
            for place, stream in streams.items():
                result.topics.setdefault(place, TopicRow(stream.source.topic, stream.clock)).add(stream)
            result.planned[path] = Planner(path.name, bag.start_ns, streams, contract, result.tally).episodes()
    return result


def _distinct(paths: Sequence[Path], labels: str) -> list[Path]:
    """Each bag once.

    Raises:
        BagError: a bag and a file of it, or two of one name, which the file of labels cannot tell apart.
    """
    distinct, named = {path.resolve(): path for path in paths}, dict[str, Path]()
    for place, path in distinct.items():
        if place.parent in distinct:
            raise BagError(f"{path} is a file of {distinct[place.parent]}, and its episodes would be there twice; name "
                           "one of the two")
        if labels and named.setdefault(path.name, path) is not path:
            raise BagError(f"{named[path.name]} and {path} have one name, and {labels} names bags by it; rename one of "
                           "them, there too")
    return list(distinct.values())


def _gap(gap: tuple[float, str] | None) -> str:
    return f"{gap[0]:.2f} s in {gap[1]}" if gap else "-"


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]
