"""Bags as arrays for training. Shapes: F frames of all episodes in a row, E episodes, H W image, A action, S state,
P ground truth. Equal index = equal frame; action f leaves frame f."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, Episode, FloatArray, UInt8Array
from wm_nodes.recording import topics
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.messages import single
from wm_nodes.recording.reader import BagReport, check_spec, read_episodes

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class EpisodeDataset:
    """Episodes of unequal length, end to end. Episode e owns frames first_frame[e] to first_frame[e + 1] - 1.

    images: uint8 (F, H, W, 3). states: float32 (F, S). ground_truth: float32 (F, P). success: bool (F,).
    actions: float32 (F, A) and rewards: float32 (F,): of the step that leaves the frame; 0 and NaN at an episode's
    last frame. first_frame: int64 (E + 1,). terminated, truncated: bool (E,), of the last step.
    """

    spec: EnvironmentSpec
    images: UInt8Array
    states: FloatArray
    actions: FloatArray
    ground_truth: FloatArray
    success: BoolArray
    rewards: FloatArray
    first_frame: IntArray
    terminated: BoolArray
    truncated: BoolArray
    tasks: tuple[str, ...]
    instructions: tuple[str, ...]
    behaviours: tuple[str, ...]
    seeds: tuple[int, ...]
    episode_ids: tuple[int, ...]
    sources: tuple[int, ...]
    policy_versions: tuple[int, ...]
    extras: tuple[Any, ...]

    @property
    def num_episodes(self) -> int:
        return len(self.first_frame) - 1

    @property
    def num_frames(self) -> int:
        return int(self.first_frame[-1])

    @property
    def lengths(self) -> IntArray:
        """Steps per episode, int64 (E,)."""
        return np.asarray(np.diff(self.first_frame) - 1, np.int64)

    @property
    def episode_of_frame(self) -> IntArray:
        """int64 (F,)."""
        return np.repeat(np.arange(self.num_episodes), np.diff(self.first_frame))

    def windows(self, num_frames: int) -> IntArray:
        """First frames of all runs of `num_frames` frames inside one episode, int64 (M,)."""
        starts = [
            np.arange(a, b - num_frames + 1) for a, b in zip(self.first_frame, self.first_frame[1:], strict=False)
        ]
        return np.asarray(np.concatenate([*starts, np.zeros(0, np.int64)]), np.int64)

    def episode(self, index: int) -> Episode:
        """Episode `index` as views of the arrays."""
        a, b = int(self.first_frame[index]), int(self.first_frame[index + 1])
        return Episode(
            images=self.images[a:b], states=self.states[a:b], actions=self.actions[a : b - 1],
            ground_truth=self.ground_truth[a:b], success=self.success[a:b], rewards=self.rewards[a : b - 1],
            terminated=bool(self.terminated[index]), truncated=bool(self.truncated[index]), task=self.tasks[index],
            instruction=self.instructions[index], behaviour=self.behaviours[index], seed=self.seeds[index],
            episode_id=self.episode_ids[index], source=self.sources[index], policy_version=self.policy_versions[index],
            extra=self.extras[index],
        )

    def select(self, indices: Sequence[int]) -> "EpisodeDataset":
        """A copy with only these episodes, in this order."""
        return dataset_of((self.episode(index) for index in indices), self.spec)


def dataset_of(episodes: Iterable[Episode], spec: EnvironmentSpec, *, frames_hint: int = 0) -> EpisodeDataset:
    """Lay episodes end to end. frames_hint: an upper bound of the frames, so that images are stored only once."""
    spec = single(spec)
    capacity = frames_hint
    images = np.empty((capacity, spec.height, spec.width, spec.channels), np.uint8)
    waiting: list[Episode] = []
    first_frame = [0]
    for episode in episodes:
        start, stop = first_frame[-1], first_frame[-1] + episode.num_steps + 1
        if stop > capacity:
            capacity = max(stop, 2 * capacity, 1024)
            grown = np.empty((capacity, *images.shape[1:]), np.uint8)
            grown[:start] = images[:start]
            images = grown
        images[start:stop] = episode.images
        first_frame.append(stop)
        waiting.append(replace(episode, images=images[:0]))
    total = first_frame[-1]
    actions = np.zeros((total, spec.action_dim), np.float32)
    rewards = np.full(total, np.nan, np.float32)
    for start, stop, episode in zip(first_frame, first_frame[1:], waiting, strict=False):
        actions[start : stop - 1] = episode.actions
        rewards[start : stop - 1] = episode.rewards
    return EpisodeDataset(
        spec=spec, images=images[:total],
        states=_concatenate([e.states for e in waiting], (0, spec.state_dim), np.float32), actions=actions,
        ground_truth=_concatenate([e.ground_truth for e in waiting], (0, spec.ground_truth_dim), np.float32),
        success=_concatenate([e.success for e in waiting], (0,), np.bool_), rewards=rewards,
        first_frame=np.array(first_frame, np.int64), terminated=np.array([e.terminated for e in waiting], bool),
        truncated=np.array([e.truncated for e in waiting], bool), tasks=tuple(e.task for e in waiting),
        instructions=tuple(e.instruction for e in waiting), behaviours=tuple(e.behaviour for e in waiting),
        seeds=tuple(e.seed for e in waiting), episode_ids=tuple(e.episode_id for e in waiting),
        sources=tuple(e.source for e in waiting), policy_versions=tuple(e.policy_version for e in waiting),
        extras=tuple(e.extra for e in waiting),
    )


def load_dataset(
    paths: Iterable[Path], *, behaviours: Collection[str] | None = None, expected: EnvironmentSpec | None = None,
    max_episodes: int | None = None, report: BagReport | None = None,
) -> EpisodeDataset:
    """Read all episodes of several bags into memory, in the order of the paths.

    Args:
        behaviours: keep only these; None keeps all.
        expected: what every bag must have been recorded with; None takes the first bag's spec.
        max_episodes: stop after so many.
        report: given, episodes that lost data are left out and counted there; else they raise.

    Raises:
        BagError: no bag, an unusable bag, bags of different cameras, sizes, actions or states, or no episode left.
    """
    bags = [Path(path) for path in paths]
    if not bags:
        raise BagError("no bags given; pass at least one folder written by EpisodeBagWriter or the recorder")
    frames, spec = 0, expected
    for path in bags:
        with Bag(path) as bag:
            namespace = bag.namespace(None)
            recorded, _ = bag.spec(namespace)
            frames += bag.count(topics.absolute(namespace, topics.IMAGES)) * recorded.num_envs
        spec = spec if spec is not None else single(recorded)
        check_spec(recorded, spec, where=str(path))
    assert spec is not None

    def episodes() -> Iterable[Episode]:
        left = max_episodes if max_episodes is not None else 2**63
        for path in bags:
            for episode in read_episodes(path, behaviours=behaviours, expected=spec, report=report):
                if left <= 0:
                    return
                left -= 1
                yield episode

    dataset = dataset_of(episodes(), spec, frames_hint=frames)
    if not dataset.num_episodes:
        wanted = "" if behaviours is None else f" with behaviour {sorted(behaviours)}"
        raise BagError(f"no complete episode{wanted} in {', '.join(map(str, bags))}")
    return dataset


def _concatenate(parts: Sequence[NDArray[Any]], empty: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    return np.concatenate([np.zeros(empty, dtype), *parts])
