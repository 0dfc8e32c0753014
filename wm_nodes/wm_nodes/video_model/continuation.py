"""Videos made clip after clip: each one goes on from the last frames of the one before.

Shapes: N videos, C channels, K given frames, n new frames of a clip, F frames, h w latent grid, A action values.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from wm_nodes.config.video import RolloutConfig
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.network import VelocityModel
from wm_nodes.video_model.sampling import initial_noise, sample_videos


@dataclass(frozen=True)
class ClipLengths:
    """given: frames that a clip goes on from, at most. new: frames that it makes."""

    given: int
    new: int

    def place(self, frames: int) -> tuple[int, int]:
        """Return the first frame and the number of given frames of the clip that goes on after `frames` frames."""
        given = min(self.given, frames)
        return frames - given, given


def clip_condition(videos: Tensor, whole: Condition, lengths: ClipLengths) -> Condition:
    """Return the condition of the clip that goes on after `videos`: its last frames, and the actions from there.

    Args:
        videos: the frames so far (N, C, F, h, w). whole: of the whole videos, with F - 1 + n actions or more.

    Raises:
        ValueError: too few actions.
    """
    F = videos.shape[2]
    first, K = lengths.place(F)
    wanted = whole.actions[:, first : F - 1 + lengths.new]
    if wanted.shape[1] != K - 1 + lengths.new:
        got = whole.actions.shape[1]
        raise ValueError(f"{lengths.new} frames after {F} need {F - 1 + lengths.new} actions, got {got}")
    return Condition(videos[:, :, first:].contiguous(), wanted.contiguous(), whole.text)


@torch.no_grad()
def continue_videos(
    model: VelocityModel, whole: Condition, lengths: ClipLengths, frames: int, seeds: Callable[[int], Tensor],
    settings: RolloutConfig,
) -> Tensor:
    """Return videos (N, C, frames, h, w) of `whole`, where the model is, clip after clip by ODE; the last clip may be
    shorter. Raises ValueError as clip_condition.

    seeds: number of the clip, from 0 -> seeds (N,) of its initial noise.
    """
    videos, clip = whole.frames, 0
    while videos.shape[2] < frames:
        new = min(lengths.new, frames - videos.shape[2])
        condition = clip_condition(videos, whole, ClipLengths(lengths.given, new))
        shape = (videos.shape[1], condition.num_conditioning + new, *videos.shape[3:])
        of_clip = seeds(clip)
        noise = initial_noise(shape, of_clip).to(videos.device)
        rollout = sample_videos(model, condition, noise, of_clip, settings, [])
        videos = torch.cat([videos, rollout.latents[:, :, -new:]], 2)
        clip += 1
    return videos
