"""Recorded episodes as clips of latents.

Shapes: E episodes, F frames, H W 3 image, C h w latents, A action, S state, P simulator state.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.tasks import get_task, same_scene
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Episode, FloatArray, UInt8Array
from wm_nodes.recording import read_episodes, read_spec
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.video_model import Condition
from wm_nodes.video_model.conditions import hashed_words
from wm_nodes.video_model.tokenizer_codec import TokenizerCodec


@dataclass(frozen=True)
class Clips:
    """Recorded episodes as clips of one length."""

    frames: Tensor
    """uint8 (E, F, H, W, 3)."""
    actions: Tensor
    """(E, F - 1, stride A), the recorded actions between two frames, one after the other."""
    ground_truth: FloatArray
    """(E, F, P) simulator state of `task`, NaN where unknown."""
    instructions: tuple[str, ...]
    """One each."""
    task: str
    """Of all of them."""
    seeds: tuple[int, ...]
    """Of the simulator's reset, one each."""
    states: FloatArray
    """(E, F, S) of the tool."""
    spec: EnvironmentSpec
    """Of the environment that was recorded."""

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, index: Tensor) -> "Clips":
        return Clips(
            self.frames[index], self.actions[index], self.ground_truth[index.numpy()],
            tuple(self.instructions[int(i)] for i in index), self.task,
            tuple(self.seeds[int(i)] for i in index), self.states[index.numpy()], self.spec,
        )

    def first(self, count: int) -> "Clips":
        """The first clips, or all where there are fewer."""
        return self.select(torch.arange(min(count, len(self))))

    def first_states(self) -> FloatArray:
        """The states (E, S) that the clips begin with."""
        return np.ascontiguousarray(self.states[:, 0])

    def window(self, first: int, frames: int) -> "Clips":
        """The frames from `first` on.

        Raises:
            ValueError: the clips have no such frames.
        """
        last = first + frames
        if last > self.frames.shape[1]:
            raise ValueError(f"recordings of {self.frames.shape[1]} frames have no frames {first} to {last - 1}")
        return replace(
            self, frames=self.frames[:, first:last], actions=self.actions[:, first : last - 1],
            ground_truth=self.ground_truth[:, first:last], states=self.states[:, first:last],
        )

    def condition(self, codec: TokenizerCodec, num_conditioning: int, text_dim: int) -> Condition:
        """Return the first frames, the actions and the instruction, where the codec is."""
        first = codec.encode(self.frames[:, :num_conditioning])
        return Condition(first, self.actions, hashed_words(self.instructions, text_dim)).to(first.device)


def load_clips(bags: Sequence[Path], stride: int, steps: int = 0, task: str = "") -> Clips:
    """Load the episodes of the bags, in order, as clips of one length: no frame is made up.

    Args:
        steps: of each clip; longer episodes are cut there, shorter ones left out. 0: all episodes have one length.
        task: of the clips. Episodes that were recorded for another one in its scene show it too; their clips have its
            instruction. Empty: the one that they were recorded for.

    Raises:
        BagError: a bag is missing, damaged, or of another version. ValueError: no episodes, of different sizes, lengths
            or tasks, of a task in another scene, or with an action or simulator state that is no number.
    """
    frames, rest = list[UInt8Array](), list[Episode]()
    for episode in (checked(episode, bag) for bag in bags for episode in read_episodes(bag)):
        if episode.num_steps >= steps:
            frames.append(episode.images[: (steps or episode.num_steps) + 1 : stride].copy())
        rest.append(replace(episode, images=np.empty((len(episode.images), 0), np.uint8)))  # pictures fill the memory
    lengths = [episode.num_steps for episode in rest]
    if not steps and len(set(lengths)) > 1:
        raise ValueError(
            f"episodes of {min(lengths)} to {max(lengths)} steps are no clips of one length; set clip_steps: longer "
            f"ones are cut there, shorter ones left out (a median of {sorted(lengths)[len(lengths) // 2]} steps)"
        )
    kept = [episode for episode in rest if episode.num_steps >= steps]
    if lengths and not kept:
        raise ValueError(f"no episode has {steps} steps, the longest {max(lengths)}; lower clip_steps")
    if len(sizes := {some.shape[1:] for some in frames}) > 1:
        raise ValueError(f"episodes of different picture sizes cannot be mixed: {sorted(sizes)}")
    recorded = sorted({episode.task for episode in kept})
    if len(recorded) > 1:
        raise ValueError(f"episodes of {', '.join(recorded)} are no clips of one task; name recordings of one of them")
    task = task or "".join(recorded)
    stacked = stack_episodes(kept, [task], num_steps=steps or None)
    instructions = stacked.instructions
    if [task] != recorded:
        if not same_scene(task, recorded[0]):
            raise ValueError(f"{bags[0]} was recorded for the task {recorded[0]}, whose scene does not show {task}; "
                             f"set task {recorded[0]}, or name other recordings")
        instructions = (get_task(task).instruction,) * len(stacked)
    if stacked.num_steps % stride:
        raise ValueError(
            f"episodes of {stacked.num_steps} steps cannot be cut at every {stride}th frame; choose a divisor"
        )
    actions = stacked.actions.reshape(len(stacked), stacked.num_steps // stride, -1)
    return Clips(
        frames=torch.from_numpy(np.stack(frames)), actions=torch.from_numpy(np.ascontiguousarray(actions)),
        ground_truth=stacked.ground_truth[:, ::stride], instructions=instructions, task=task,
        seeds=stacked.seeds, states=stacked.states[:, ::stride], spec=read_spec(bags[0]),
    )


def checked(episode: Episode, bag: Path) -> Episode:
    """The episode, each value of whose simulator state is a number in all frames or in none; recorded without simulator
    state, with an unknown one.

    Raises:
        ValueError: another one; names the first wrong value.
    """
    truth = episode.ground_truth
    wrong = ~np.isfinite(truth) & ~np.isnan(truth).all(0)
    if wrong.any():
        place = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            f"{bag}: episode {episode.episode_id}: ground_truth{list(place)} is {truth[place]}; record the episode "
            "again, or leave its bag out"
        )
    if truth.shape[1]:
        return episode
    names = get_task(episode.task).ground_truth_names
    return replace(episode, ground_truth=np.full((len(episode.images), len(names)), np.nan, np.float32))
