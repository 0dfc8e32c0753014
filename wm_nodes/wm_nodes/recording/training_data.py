"""Recordings as the data of a world model: which episodes are trained on, which are held out, what was lost and why.
Shapes: E episodes, J tasks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wm_nodes.config.tasks import model_tasks, success_or_recorded
from wm_nodes.core.errors import first_few
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import MODEL_FIELDS, EnvironmentSpec
from wm_nodes.core.types import TRY, BoolArray, Episode
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.reader import BagReport, check_spec, read_episodes, read_spec

PART_STEPS = 64
"""An episode of more steps is trained on and rolled out in parts of at most so many, of equal length."""
MIN_EPISODES, MIN_SUCCESSES = 8, 2
"""So that two episodes are held out, and one that succeeds is on either side."""
HELDOUT_SHARE = 0.25


@dataclass(frozen=True)
class TrainingData:
    """Recorded episodes of one environment, all of them, in two sets."""

    spec: EnvironmentSpec
    """Of all bags; num_envs is the first one's."""
    tasks: tuple[str, ...]
    """The J tasks that success is about."""
    training: EpisodeArrays
    """Episodes or their parts."""
    heldout: EpisodeArrays
    """The same of other episodes, never trained on."""
    num_episodes: int
    """How many are trained on, whole ones."""
    summary: tuple[str, ...]
    """What was used, what was lost and why, a line each."""


def read_training_data(
    bags: Sequence[Path], *, num_heldout: int, seed: int, task: str = "", ground_truth: bool = True,
    check: Callable[[EnvironmentSpec], object] = lambda spec: None,
) -> tuple[TrainingData, list[Episode]]:
    """Read the complete episodes of bags and hold a share of those that succeed, and of those that do not, back.

    Episodes of one try (core.types.TRY) are counted as one and stay together.

    Args:
        num_heldout: most episodes to hold out; at most a quarter is, and at least one of each kind.
        task: that the bags must be of; empty: any.
        ground_truth: False: as if none had been recorded.
        check: raises for a spec that is no use, before an episode is read.

    Returns:
        The data, and the episodes that are trained on, whole.

    Raises:
        BagError: bags of different cameras, sizes, actions, states or tasks, of another task, without actions, without
            any success, or with too few episodes.
    """
    recorded = spec = _common_spec(bags, task, check)
    episodes, tries, lost = _read(bags, spec)
    if not ground_truth:
        spec = replace(spec, ground_truth_names=())
        episodes = [replace(episode, ground_truth=episode.ground_truth[:, :0]) for episode in episodes]
    named, num_tries = ", ".join(map(str, bags)), len(set(tries))
    of_tries = f" of {num_tries} tries" if num_tries < len(episodes) else ""
    if num_tries < MIN_EPISODES:
        more = "".join(f"; {line}" for line in lost)
        raise BagError(f"{_count(len(episodes), 'complete episode')}{of_tries} in {named}, and {MIN_EPISODES} are "
                       f"needed, a quarter of them to judge the model by; record more{more}")
    if all(np.ptp(np.concatenate([e.actions[:, i] for e in episodes])) == 0 for i in range(spec.action_dim)):
        raise BagError(f"every action in {named} is {episodes[0].actions[0].tolist()}, so nothing shows what actions "
                       "do; record while the robot is commanded")
    won = np.array([success_or_recorded(spec.task, e.ground_truth, e.success)[1:].any() for e in episodes], bool)
    won_tries = np.bincount(tries, won) > 0
    if won_tries.sum() < MIN_SUCCESSES:
        kind = "tries" if of_tries else "episodes"
        raise BagError(f"{won_tries.sum()} of {num_tries} {kind} in {named} succeed, and {MIN_SUCCESSES} are needed, "
                       "to learn when the task is done and to judge that; record successes, and set the success flag "
                       "of wm/env/transition (success_probability) where the task is done")
    tasks = model_tasks(spec.task) if spec.ground_truth_names else (spec.task,)
    most = min(spec.max_episode_steps or PART_STEPS, PART_STEPS)
    parts = [[*_parts(episode, most)] for episode in episodes]
    longest = max(part.num_steps for of_one in parts for part in of_one)
    held = _heldout(won_tries, num_heldout, seed)[tries]  # one draw for each try
    training, heldout = (
        stack_episodes([part for of_one, its in zip(parts, held) if its == is_held for part in of_one], tasks,
                       num_steps=most if spec.ground_truth_names else longest,
                       tries=[number for of_one, its, number in zip(parts, held, tries.tolist()) if its == is_held
                              for _ in of_one])
        for is_held in (False, True)
    )
    chosen = [episode for episode, its in zip(episodes, held) if not its]
    withheld = ["the recorded ground truth is not used (data.ground_truth)"] if recorded != spec else []
    cut = [f"{len(episodes)} episodes{of_tries}; those of one try are all trained on or all held out"] * bool(of_tries)
    summary = *_used(spec, episodes, parts, won, held), *cut, *withheld, *lost
    return TrainingData(spec, tasks, training, heldout, len(chosen), summary), chosen


def _common_spec(bags: Sequence[Path], task: str, check: Callable[[EnvironmentSpec], object]) -> EnvironmentSpec:
    """The spec that all bags have, checked before any episode is read. Arguments: as of read_training_data."""
    first, *others = specs = [read_spec(bag) for bag in bags]
    for bag, spec in zip(bags, specs):
        if task and spec.task != task:
            raise BagError(f"{bag} was recorded for task {spec.task!r}, not {task!r}; leave --task out to take the "
                           "recorded success flags")
    check(first)
    if not first.action_dim:
        raise BagError(f"{bags[0]} was recorded without actions (its spec names none), and a world model learns what "
                       "actions do; record the commands of the robot too")
    for bag, spec in zip(bags[1:], others):
        check_spec(spec, first, where=str(bag), names=(*MODEL_FIELDS, "ground_truth_names"))
        if spec.task != first.task and spec.task not in model_tasks(first.task):
            raise BagError(f"{bag} was recorded for task {spec.task!r}, {bags[0]} for {first.task!r}; train a model of "
                           "each")
    return first


def _read(bags: Sequence[Path], spec: EnvironmentSpec) -> tuple[list[Episode], NDArray[np.int64], list[str]]:
    """All complete episodes, (E,) the try of each, from 0, and a line for each way in which others were lost."""
    episodes, tries, lost = list[Episode](), list[int](), list[str]()
    numbers = dict[tuple[Path, bool, int], int]()
    for bag in bags:
        report = BagReport()
        for episode in read_episodes(bag, expected=spec, report=report):
            if episode.task not in {spec.task, *model_tasks(spec.task)}:
                raise BagError(f"episode {episode.episode_id} in {bag} is of task {episode.task!r}, the bag of "
                               f"{spec.task!r}; train a model of each")
            is_numbered = TRY in episode.extra
            key = bag, is_numbered, episode.extra[TRY] if is_numbered else len(episodes)
            tries.append(numbers.setdefault(key, len(numbers)))
            episodes.append(episode)
        if report.unfinished:
            lost.append(f"lost from {bag}: {_count(report.unfinished, 'episode')} cut off by the start or end of the "
                        "recording")
        if report.incomplete:
            lost.append(f"lost from {bag}: {_count(len(report.incomplete), 'incomplete episode')} "
                        f"({first_few(report.incomplete)})")
        if report.lost_steps:
            lost.append(f"lost from {bag}: {_count(report.lost_steps, 'message')} of wm/env/transition that the "
                        "recorder did not get")
    return episodes, np.array(tries, np.int64), lost or ["lost: nothing"]


def _parts(episode: Episode, most: int) -> Iterator[Episode]:
    """An episode in parts of at most so many steps, each of which begins at the last frame of the one before."""
    count = -(-episode.num_steps // most)
    edges = np.linspace(0, episode.num_steps, count + 1).round().astype(int)
    for first, last in pairwise(edges):
        frames, ends = slice(first, last + 1), last == episode.num_steps
        yield replace(
            episode, images=episode.images[frames], states=episode.states[frames],
            actions=episode.actions[first:last], ground_truth=episode.ground_truth[frames],
            success=episode.success[frames], rewards=episode.rewards[first:last],
            terminated=episode.terminated and ends, truncated=episode.truncated or not ends,
        )


def _heldout(won: BoolArray, most: int, seed: int) -> BoolArray:
    """(E,), which episodes are held out: the same share, drawn from `seed`, of both kinds."""
    share = min(most / len(won), HELDOUT_SHARE)
    held = np.zeros(len(won), bool)
    for kind in (True, False):
        rows: NDArray[np.int64] = np.flatnonzero(won == kind)
        if len(rows) > 1:
            count = max(1, int(share * len(rows) + 1e-9))
            held[numpy_stream(seed, "heldout", int(kind)).permutation(rows)[:count]] = True
    return held


def _used(
    spec: EnvironmentSpec, episodes: Sequence[Episode], parts: Sequence[Sequence[Episode]], won: BoolArray,
    held: BoolArray,
) -> Iterator[str]:
    steps, measured, count = sum(e.num_steps for e in episodes), len(spec.measured), len(episodes)
    yield (f"{spec.env_id}, task {spec.task or '(none)'}: {len(spec.cameras)} x {spec.height} x "
           f"{spec.width // max(1, len(spec.cameras))} px ({', '.join(spec.cameras)}), {spec.action_dim} actions, "
           f"{spec.tool_dim - measured} commanded and {measured} measured state values")
    yield f"used: {count} episodes, {steps} steps, {steps + count} frames; {won.sum()} succeed"
    yield (f"trained on: {(~held).sum()} ({(won & ~held).sum()} succeed); "
           f"held out: {held.sum()} ({(won & held).sum()} succeed)")
    if long := [len(of_one) for of_one in parts if len(of_one) > 1]:
        yield f"{_count(len(long), 'long episode')} in {sum(long)} parts, with every step"
    if done := sum(bool(episode.success[0]) for episode in episodes):
        yield f"{_count(done, 'episode')} already done in the first frame: no demonstration, and nothing starts there"
    if len(texts := {episode.instruction for episode in episodes}) > 1:
        yield f"{len(texts)} instructions: goals follow them; the done signal and the policy do not read them"


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}" + ("" if number == 1 else "s")
