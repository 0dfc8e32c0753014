"""Bags as arrays for training. Shapes: F frames of all episodes in a row, E episodes, H W image, A action, S state,
P ground truth. Equal index = equal frame; action f leaves frame f."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, Episode, FloatArray, UInt8Array
from wm_nodes.recording import topics
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.messages import single
from wm_nodes.recording.reader import BagReport, check_spec, read_episodes


@dataclass(frozen=True)
class EpisodeDataset:
    """Episodes of unequal length, end to end. Episode e owns frames first_frame[e] to first_frame[e + 1] - 1.

    images: uint8 (F, H, W, 3). states: float32 (F, S). ground_truth: float32 (F, P). success: bool (F,).
    actions: float32 (F, A) and rewards: float32 (F,): of the step that leaves the frame; 0 and NaN at an episode's
    last frame. first_frame: int64 (E + 1,).
    """

    spec: EnvironmentSpec
    images: UInt8Array
    states: FloatArray
    actions: FloatArray
    ground_truth: FloatArray
    success: BoolArray
    rewards: FloatArray
    first_frame: NDArray[np.int64]
    episodes: tuple[Episode, ...]
    """Their images are views of `images`."""

    @property
    def num_episodes(self) -> int:
        return len(self.episodes)


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
    images = np.empty((frames, spec.height, spec.width, spec.channels), np.uint8)
    episodes, first_frame = list[Episode](), [0]
    recordings = (read_episodes(path, behaviours=behaviours, expected=spec, report=report) for path in bags)
    for episode in islice(chain.from_iterable(recordings), max_episodes):
        frame, stop = first_frame[-1], first_frame[-1] + episode.num_steps + 1
        images[frame:stop] = episode.images
        first_frame.append(stop)
        episodes.append(replace(episode, images=images[frame:stop]))
    if not episodes:
        wanted = "" if behaviours is None else f" with behaviour {sorted(behaviours)}"
        raise BagError(f"no complete episode{wanted} in {', '.join(map(str, bags))}")
    actions = np.zeros((stop, spec.action_dim), np.float32)
    rewards = np.full(stop, np.nan, np.float32)
    for frame, episode in zip(first_frame, episodes, strict=False):
        actions[frame : frame + episode.num_steps] = episode.actions
        rewards[frame : frame + episode.num_steps] = episode.rewards
    return EpisodeDataset(
        spec=single(spec), images=images[:stop], states=np.concatenate([e.states for e in episodes]), actions=actions,
        ground_truth=np.concatenate([e.ground_truth for e in episodes]),
        success=np.concatenate([e.success for e in episodes]), rewards=rewards,
        first_frame=np.array(first_frame, np.int64), episodes=tuple(episodes),
    )
