"""Recorded episodes stacked for training. Shapes: E episodes, T steps, H W 3 image, J tasks, P truths."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.config.tasks import parts_of, shares_scene, success_or_recorded
from wm_nodes.core.types import BoolArray, Episode, FloatArray, UInt8Array


@dataclass(frozen=True)
class EpisodeArrays:
    """E episodes padded to T steps by repeating their last frame; only the first `lengths` steps are real."""

    images: UInt8Array
    """(E, T + 1, H, W, 3)."""
    states: FloatArray
    """(E, T + 1, S), of the tool."""
    actions: FloatArray
    """(E, T, A), 0 where padded."""
    ground_truth: FloatArray
    """(E, T + 1, P)."""
    success: BoolArray
    """(E, T + 1, J), column j for tasks[j], see `labelled`."""
    lengths: NDArray[np.int64]
    """(E,), real steps."""
    tasks: tuple[str, ...]
    """The J tasks that success is about."""
    instructions: tuple[str, ...]
    """(E,)."""
    behaviours: tuple[str, ...]
    """(E,), who acted."""
    recorded_tasks: tuple[str, ...]
    """(E,), the task that each was recorded for, with its instruction; where the state says which task it is
    (Task.parts), that one."""
    seeds: tuple[int, ...] = ()
    """(E,), of their resets; () where unknown."""
    tries: tuple[int, ...] = ()
    """(E,), the number of the try that each is a part of; () where each is a whole one."""

    def __len__(self) -> int:
        return len(self.images)

    @property
    def independent(self) -> NDArray[np.int64]:
        """(E,), equal where two are of one try, which are not independent of each other."""
        return np.array(self.tries or range(len(self)), np.int64)

    @property
    def num_steps(self) -> int:
        return self.actions.shape[1]

    @property
    def step_mask(self) -> BoolArray:
        """(E, T), True where the step was recorded."""
        return np.arange(self.num_steps) < self.lengths[:, None]

    @property
    def frame_mask(self) -> BoolArray:
        """(E, T + 1), True where the frame was recorded."""
        return np.arange(self.num_steps + 1) <= self.lengths[:, None]

    @property
    def labelled(self) -> BoolArray:
        """(E, J), True where the episode shows whether the task is done, see config.tasks.shares_scene."""
        recorded_tasks = set(self.recorded_tasks)
        known = {(recorded, task): shares_scene(recorded, task) for recorded in recorded_tasks for task in self.tasks}
        return np.array([[known[recorded, task] for task in self.tasks] for recorded in self.recorded_tasks])

    def select(self, rows: Sequence[int] | NDArray[Any]) -> "EpisodeArrays":
        index = np.asarray(rows, np.int64)
        return EpisodeArrays(
            self.images[index], self.states[index], self.actions[index], self.ground_truth[index], self.success[index],
            self.lengths[index], self.tasks, tuple(self.instructions[i] for i in index),
            tuple(self.behaviours[i] for i in index), tuple(self.recorded_tasks[i] for i in index),
            tuple(self.seeds[i] for i in index) if self.seeds else (),
            tuple(self.tries[i] for i in index) if self.tries else (),
        )

    @classmethod
    def concatenate(cls, parts: Sequence["EpisodeArrays"]) -> "EpisodeArrays":
        """All episodes of parts that have the same tasks and number of steps."""
        if len({(part.tasks, part.num_steps) for part in parts}) != 1:
            raise ValueError(f"parts differ in tasks or steps: {[(part.tasks, part.num_steps) for part in parts]}")
        arrays = ("images", "states", "actions", "ground_truth", "success", "lengths")
        return cls(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}, tasks=parts[0].tasks,
            instructions=tuple(text for part in parts for text in part.instructions),
            behaviours=tuple(text for part in parts for text in part.behaviours),
            recorded_tasks=tuple(task for part in parts for task in part.recorded_tasks),
            seeds=tuple(seed for part in parts for seed in part.seeds) if all(part.seeds for part in parts) else (),
        )


def check_finite(episodes: Iterable[Episode]) -> None:
    """Raise ValueError that names the first state or action of an episode that is not finite, before it trains."""
    for episode in episodes:
        for name in ("states", "actions"):
            array = getattr(episode, name)
            if not np.isfinite(array).all():
                where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
                raise ValueError(
                    f"episode {episode.episode_id} (task {episode.task}, seed {episode.seed}) has {array[where]} in "
                    f"{name}{list(where)}; leave it out, or record it again"
                )


def stack_episodes(
    episodes: Iterable[Episode], tasks: Sequence[str], *, num_steps: int | None = None, tries: Sequence[int] = (),
) -> EpisodeArrays:
    """Stack episodes of one camera set-up; longer ones are cut to num_steps (None: the longest decides). tries: see
    EpisodeArrays.

    Whether a task is done is as in config.tasks.success_or_recorded.

    Raises:
        ValueError: no episodes, episodes of different image, state or action sizes, or as check_finite.
    """
    listed = list(episodes)
    check_finite(listed)
    if not listed:
        raise ValueError("no episodes to train on; collect some first (data.num_episodes) or check the bag path")
    known = {task: parts_of(task) for task in {e.task for e in listed}}
    parts = [known[e.task] if known[e.task] != (e.task,) else () for e in listed]
    tool_states = [e.states[:, : e.states.shape[1] - len(own)] for e, own in zip(listed, parts, strict=True)]
    shapes = {(e.images.shape[1:], s.shape[1:], e.actions.shape[1:]) for e, s in zip(listed, tool_states, strict=True)}
    if len(shapes) > 1:
        raise ValueError(f"episodes of different image, state or action sizes cannot be mixed: {sorted(shapes)}")
    steps = num_steps or max(e.num_steps for e in listed)
    frame_rows = [np.minimum(np.arange(steps + 1), e.num_steps) for e in listed]
    lengths = np.array([min(e.num_steps, steps) for e in listed], np.int64)
    actions = np.zeros((len(listed), steps, listed[0].actions.shape[1]), np.float32)
    images = np.empty((len(listed), steps + 1, *listed[0].images.shape[1:]), listed[0].images.dtype)
    for row, episode in enumerate(listed):
        actions[row, : lengths[row]] = episode.actions[: lengths[row]]
        images[row] = episode.images[frame_rows[row]]  # one by one: they are most of the memory
    truth = np.stack([e.ground_truth[rows] for e, rows in zip(listed, frame_rows, strict=True)])
    said = np.stack([e.success[rows] for e, rows in zip(listed, frame_rows, strict=True)])
    return EpisodeArrays(
        images=images,
        states=np.stack([s[rows] for s, rows in zip(tool_states, frame_rows, strict=True)]), actions=actions,
        ground_truth=truth,
        success=np.stack([np.asarray(success_or_recorded(task, truth, said), bool) for task in tasks], -1),
        lengths=lengths, tasks=tuple(tasks), instructions=tuple(e.instruction for e in listed),
        behaviours=tuple(e.behaviour for e in listed), recorded_tasks=tuple(
            own[int(e.states[0, -len(own) :].argmax())] if own else e.task for e, own in zip(listed, parts, strict=True)
        ), seeds=tuple(e.seed for e in listed), tries=tuple(tries),
    )
