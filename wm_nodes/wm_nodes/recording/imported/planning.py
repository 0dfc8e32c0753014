"""The episodes of one bag, before a picture is decoded: where they begin and end, what was seen and commanded at each
tick. Shapes: K ticks of a span, T steps of an episode, S state, A action, V cameras.

A span is what the contract's split cuts out, from its first command to its last; its ticks are one period apart.
Observation k is the newest sample of each topic at or before tick k, action k what was commanded in [k, k + 1). Where
one of them is missing, the span is cut: nothing is filled.
"""

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.imported.contract import BOOL, Commands, Contract, InstructionTopic
from wm_nodes.recording.imported.streams import SAMPLED, Stream, Times
from wm_nodes.recording.messages import NS_PER_S

NEVER_NS = 2**63 - 1
LONGEST_S = 86_400
"""Of an episode."""
SEVERAL = 3
"""Messages about success within an episode, from which on those that come after it no longer count."""
LABEL_COLUMNS = ("bag", "start_s", "end_s", "success")


@dataclass(frozen=True)
class Span:
    """An episode as it was recorded."""

    start_ns: int
    """Of its first tick."""
    end_ns: int
    """Of its last tick, at most."""
    until_ns: int
    """When the next one begins."""


@dataclass(frozen=True)
class PlannedEpisode:
    """An episode of ours, without its pictures."""

    ticks: Times
    """(T + 1,), ns on the contract's clock."""
    pictures: NDArray[np.int64]
    """(T + 1, V), of each camera the place among the messages of its topic."""
    states: FloatArray
    """(T + 1, S)."""
    actions: FloatArray
    """(T, A), in [-1, 1]."""
    probes: FloatArray
    """(T + 1, P)."""
    success: BoolArray
    """(T + 1,)."""
    rewards: FloatArray
    """(T,), NaN where none is recorded."""
    instruction: str
    """What was asked for."""
    try_number: int
    """Of its span, among those of all bags."""


@dataclass
class Tally:
    """What planning counted."""

    spans: int = 0
    """Of all bags."""
    ticks: int = 0
    """Of all spans, from their first to their last command."""
    missing: Counter[str] = field(default_factory=Counter)
    """Ticks without a sample, by place in the contract."""
    lost: Counter[str] = field(default_factory=Counter)
    """Steps of no episode, by reason."""
    lost_episodes: Counter[str] = field(default_factory=Counter)
    """Stretches and spans that became no episode, by reason."""
    gaps: dict[str, tuple[float, str]] = field(default_factory=dict)
    """Largest distance of two samples within a span, s, and where, by place."""
    commanded: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Least and largest command of a step, by the action's name."""
    beyond: Counter[str] = field(default_factory=Counter)
    """Steps with a command beyond the limits, by the action's name."""
    steps: int = 0
    """Of all episodes."""
    unlabelled: int = 0
    """Spans of whose success nothing was said: failures."""


def spans_of(streams: Mapping[str, Stream], contract: Contract) -> list[Span]:
    """Where the episodes of a bag lie."""
    split = contract.episodes.split
    commands = np.sort(np.concatenate([s.times for place, s in streams.items() if place.startswith("actions")]))
    if split.per:
        used = [stream for place, stream in streams.items() if place.startswith(SAMPLED)]
        bounds = [(min(int(s.times[0]) for s in used), max(int(s.times[-1]) for s in used))]
    elif split.gap_s:
        cuts = np.flatnonzero(np.diff(commands) > split.gap_s * NS_PER_S)
        starts, ends = [0, *(cuts + 1)], [*cuts, len(commands) - 1]
        bounds = [(int(commands[a]), int(commands[b]) + contract.period_ns) for a, b in zip(starts, ends)]
    else:
        says = streams["split"]
        bounds, begun = [], NEVER_NS
        for time_ns, running in zip(says.times.tolist(), says.values[:, 0] > 0):
            if running and begun == NEVER_NS:
                begun = time_ns
            elif not running and begun < NEVER_NS:
                bounds.append((begun, time_ns))
                begun = NEVER_NS
        if begun < NEVER_NS:
            bounds.append((begun, int(commands[-1]) + contract.period_ns))
    nexts = [start for start, _ in bounds[1:]] + [NEVER_NS]
    return [Span(start, end, until) for (start, end), until in zip(bounds, nexts)]


class Planner:
    """Plans the episodes of one bag.

    Args:
        name: of the bag, for labels and errors.
        begun_ns: receive time of its first message.
    """

    def __init__(
        self, name: str, begun_ns: int, streams: Mapping[str, Stream], contract: Contract, tally: Tally
    ) -> None:
        self.name, self.begun_ns, self.streams, self.contract, self.tally = name, begun_ns, streams, contract, tally
        self._images, self._state, self._actions, self._probes = (
            [stream for place, stream in streams.items() if place.startswith(kind)]
            for kind in SAMPLED
        )
        labels = contract.episodes.success.file
        self._labels = _labels_of(labels, name) if labels else ()

    def episodes(self) -> list[PlannedEpisode]:
        """Raises BagError: a span without a label."""
        return [episode for span in spans_of(self.streams, self.contract) for episode in self._of_span(span)]

    def _of_span(self, span: Span) -> list[PlannedEpisode]:
        contract, tally, ticks = self.contract, self.tally, self._ticks(span)
        tally.spans += 1
        commands, has = self._commands(ticks)
        moved = np.flatnonzero(has.all(1))
        if not len(moved):
            silent = [stream.place for stream, ever in zip(self._actions, has.any(0), strict=True) if not ever]
            tally.lost_episodes[f"without a command of {' and '.join(silent) or 'all topics at once'}"] += 1
            return []
        inside = slice(moved[0], moved[-1] + 2)
        tally.lost["before the first command or after the last"] += len(ticks) - len(ticks[inside])
        ticks, commands, has = ticks[inside], commands[inside], has[inside]
        instruction = self._instruction(span)
        if instruction is None:
            tally.lost_episodes["without an instruction"] += 1
            return []
        seen, (success, rewards) = self._seen(ticks, has), self._outcome(ticks, span)
        joined = seen[:-1] & seen[1:] & has[:-1].all(1)
        pictures = np.stack([stream.numbers[stream.newest(ticks)] for stream in self._images], 1)
        states, probes = self._newest(self._state, ticks), self._newest(self._probes, ticks)
        commands = self._relative(commands, states)
        actions = self._scaled(commands)
        planned, covered = list[PlannedEpisode](), 0
        for start, steps in _stretches(joined):
            if steps < contract.episodes.min_steps:
                tally.lost_episodes[f"shorter than min_steps {contract.episodes.min_steps}"] += 1
                continue
            covered += steps
            rows, frames = slice(start, start + steps), slice(start, start + steps + 1)
            self._count_commands(actions[rows], commands[rows])
            planned.append(PlannedEpisode(
                ticks[frames], pictures[frames], states[frames].astype(np.float32),
                np.clip(actions[rows], -1, 1).astype(np.float32), probes[frames].astype(np.float32), success[frames],
                rewards[frames][1:], instruction, tally.spans,
            ))
        tally.lost["in gaps and short stretches"] += len(joined) - covered
        if success[-1] and not (planned and planned[-1].ticks[-1] == ticks[-1]):
            tally.lost_episodes["with a success at the end"] += 1
        return planned

    def _ticks(self, span: Span) -> Times:
        """(K,) of a span. Raises BagError: it lasts too long."""
        if (lasts_s := (span.end_ns - span.start_ns) / NS_PER_S) > LONGEST_S:
            raise BagError(f"an episode in {self.name} lasts {lasts_s / 3600:.0f} h: a clock was set while it was "
                           "recorded; set timeline to the other clock, or leave this bag out")
        return np.arange(span.start_ns, span.end_ns + 1, self.contract.period_ns, dtype=np.int64)

    @staticmethod
    def _newest(streams: Sequence[Stream], ticks: Times) -> NDArray[np.float64]:
        """(K, D) the newest values of all of them."""
        values = [stream.values[stream.newest(ticks)] for stream in streams]
        return np.concatenate([np.zeros((len(ticks), 0)), *values], 1)

    def _seen(self, ticks: Times, commanded: BoolArray) -> BoolArray:
        """(K,) whether every topic but commands has a sample that is new enough; counts ticks without one, and gaps.

        commanded: (K, topics), of _commands; after the last frame nothing is, and nothing is missing.
        """
        observed = (*self._images, *self._state, *self._probes)
        fresh = [self._is_fresh(stream, ticks) for stream in observed]
        self.tally.ticks += len(ticks)
        streams = (*observed, *self._actions)
        for stream, has in zip(streams, (*fresh, *commanded[:-1].T), strict=True):
            place = stream.place
            self.tally.missing[place] += int((~has).sum())
            inside = stream.times[slice(*np.searchsorted(stream.times, ticks[[0, -1]]))]
            times = np.concatenate([ticks[:1], inside, ticks[-1:]])
            largest = int(np.diff(times).argmax())
            gap_s = float(np.diff(times)[largest]) / NS_PER_S
            if gap_s > self.tally.gaps.get(place, (0.0, ""))[0]:
                begins_s = (times[largest] + int(stream.offset_ms * 1e6) - self.begun_ns) / NS_PER_S
                self.tally.gaps[place] = gap_s, f"{self.name} at {begins_s:.1f} s"
        return np.asarray(np.logical_and.reduce(fresh))

    def _is_fresh(self, stream: Stream, ticks: Times) -> BoolArray:
        newest = stream.newest(ticks)
        return (newest >= 0) & (ticks - stream.times[newest] <= self.contract.max_age_ns(stream.source))

    def _command(self, stream: Stream, ticks: Times) -> tuple[NDArray[np.float64], BoolArray]:
        """(K, D) what was commanded from each tick to the next, and (K,) whether anything was."""
        assert isinstance(stream.source, Commands)
        times, ends, holds = stream.times, ticks + self.contract.period_ns, self._is_fresh(stream, ticks)
        first, last = np.searchsorted(times, ticks), np.searchsorted(times, ends) - 1
        has = holds | (last >= first)
        if stream.source.resample == "last":
            return stream.values[np.maximum(last, 0)], has
        begins = np.where(holds, ticks, times[np.minimum(first, len(times) - 1)])
        spent = np.maximum(ends - begins, 1)[:, None]
        return (stream.integral(ends) - stream.integral(begins)) / spent, has

    def _commands(self, ticks: Times) -> tuple[NDArray[np.float64], BoolArray]:
        """(K, A) commands in their units, and (K, topics) whether there is one of each topic."""
        parts = [self._command(stream, ticks) for stream in self._actions]
        return np.concatenate([values for values, _ in parts], 1), np.stack([has for _, has in parts], 1)

    def _relative(self, commands: NDArray[np.float64], states: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, A) commands, those of joints' targets as changes; of angles the shorter way round."""
        names, commands = self.contract.state_names, commands.copy()
        sources = [source for source in self.contract.actions for _ in source.select]
        for column, source in enumerate(sources):
            if source.relative_to == "state":
                commands[:, column] -= states[:, names.index(self.contract.action_names[column])]
                if source.unit == "rad":
                    commands[:, column] = (commands[:, column] + np.pi) % (2 * np.pi) - np.pi
        return commands

    def _scaled(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, A), low to -1 and high to 1, not clipped."""
        sources = self.contract.actions
        low, high = (np.concatenate([getattr(source, name) for source in sources]) for name in ("low", "high"))
        return np.asarray(2 * (commands - low) / (high - low) - 1)

    def _count_commands(self, actions: NDArray[np.float64], commands: NDArray[np.float64]) -> None:
        self.tally.steps += len(actions)
        for column, name in enumerate(self.contract.action_names):
            low, high = self.tally.commanded.get(name, (np.inf, -np.inf))
            values = commands[:, column]
            self.tally.commanded[name] = min(low, float(values.min())), max(high, float(values.max()))
            self.tally.beyond[name] += int((np.abs(actions[:, column]) > 1 + 1e-6).sum())

    def _outcome(self, ticks: Times, span: Span) -> tuple[BoolArray, FloatArray]:
        """(K,) success at each frame, and (K,) the reward for reaching it, NaN where none came since the last."""
        success, rewards = np.zeros(len(ticks), bool), np.full(len(ticks), np.nan, np.float32)
        says = self.streams.get("success")
        if says is None:
            success[-1] = self._label(span)
            return success, rewards
        if not len(says.times):
            self.tally.unlabelled += 1
            return success, rewards
        newest = says.newest(np.append(ticks[:-1], self._said_until_ns(says, span)))
        values, times = says.values[newest, 0], says.times[newest]
        known = (newest >= 0) & (times >= span.start_ns)
        self.tally.unlabelled += not known[-1]
        limit, at_end = self.contract.episodes.success.above or 0, int(says.newest(ticks[-1:])[0])
        success = known & (values > limit)
        if at_end >= 0 and says.times[at_end] >= span.start_ns:
            success[-1] |= says.values[at_end, 0] > limit
        if says.source.type != BOOL:
            rewards = np.where(known & (times > ticks - self.contract.period_ns), values, np.nan).astype(np.float32)
        return success, rewards

    def _said_until_ns(self, says: Stream, span: Span) -> int:
        """Until when what is said of success counts for the last frame, see contract.Success.topic."""
        first, last = np.searchsorted(says.times, [span.start_ns, span.end_ns + 1])
        if last - first < SEVERAL:
            return span.until_ns - 1
        return min(span.until_ns - 1, span.end_ns + self.contract.period_ns // 2)

    def _instruction(self, span: Span) -> str | None:
        said = self.contract.episodes.instruction
        if not isinstance(said, InstructionTopic):
            return said
        newest = int(self.streams["instruction"].newest(np.array([span.end_ns]))[0])
        return self.streams["instruction"].texts[newest] if newest >= 0 else None

    def _label(self, span: Span) -> bool:
        offsets_ms = [stream.offset_ms for stream in self.streams.values() if stream.clock == "header"] or [0.0]
        middle_ns = (span.start_ns + span.end_ns) / 2 + 1e6 * float(np.median(offsets_ms))
        middle_s = (middle_ns - self.begun_ns) / NS_PER_S
        for start_s, end_s, success in self._labels:
            if start_s <= middle_s <= end_s:
                return success
        raise BagError(
            f"{self.contract.episodes.success.file} has no row for {self.name} at {middle_s:.1f} s, the middle of an "
            f"episode; add one: {','.join(LABEL_COLUMNS)}"
        )


def _stretches(joined: BoolArray) -> list[tuple[int, int]]:
    """(start, steps) of each longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], joined, [0]])))
    return [(int(start), int(end - start)) for start, end in edges.reshape(-1, 2)]


def _labels_of(file: str, bag: str) -> Sequence[tuple[float, float, bool]]:
    """(start s, end s, success) of a bag in the file of labels, in the order of time.

    Raises:
        BagError: no such file, column or number, or rows that overlap.
    """
    try:
        with Path(file).open(newline="", encoding="utf-8-sig") as stream:  # a spreadsheet may write a byte order mark
            table = csv.DictReader(stream)
            if not {*LABEL_COLUMNS} <= {*(table.fieldnames or ())}:
                raise ValueError(f"its first line is {','.join(table.fieldnames or ())!r}")
            rows = sorted(
                (float(row["start_s"] or 0), float(row["end_s"] or np.inf), bool(int(row["success"])))
                for row in table if row["bag"] == bag
            )
    except (OSError, ValueError, TypeError) as error:
        raise BagError(f"labels {file} cannot be read: {error}; it is a CSV with the columns "
                       f"{', '.join(LABEL_COLUMNS)}, success 0 or 1") from None
    for (start_s, end_s, _), (next_s, last_s, _) in pairwise(rows):
        if next_s < end_s:
            raise BagError(f"labels {file} have two rows of {bag} that overlap, {start_s:g} to {end_s:g} s and "
                           f"{next_s:g} to {last_s:g} s; leave one row for each time")
    return rows
