"""Tokenised episodes, and which parts of them a model is trained on. Shapes: E episodes, B parts of some, T steps, S
tokens, D values per token, A action, P state or probed values, J tasks, H W 3 image."""

from dataclasses import dataclass

import torch
from torch import Tensor

from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.tokenizer import probed_targets

MOVING_SHARE, MOVED = 0.75, 0.005
"""See first_frames. A tool has moved whose commanded state has changed by more than MOVED (m, rad, or gripper)."""
ENCODING_BATCH = 256


@dataclass(frozen=True)
class LatentEpisodes:
    """Tokenised episodes."""

    images: Tensor
    """(E, T + 1, H, W, 3), as in EpisodeArrays."""
    latents: Tensor
    """float16 (E, T + 1, S, D)."""
    mean_change_S: Tensor
    """float32 (S,), mean absolute change of each token since the first frame."""
    states: Tensor
    """(E, T + 1, S), as in EpisodeArrays."""
    actions: Tensor
    """(E, T, A), as in EpisodeArrays."""
    success: Tensor
    """(E, T + 1, J), as in EpisodeArrays."""
    labelled: Tensor
    """(E, J), as in EpisodeArrays."""
    truth: Tensor
    """float32 (E, T + 1, P), m."""
    step_mask: Tensor
    """(E, T), as in EpisodeArrays."""

    def __len__(self) -> int:
        return len(self.latents)

    def parts(self, index: Tensor, first: Tensor, steps: int) -> "LatentEpisodes":
        """`steps` steps of each of the episodes `index` (B,), from frame `first` (B,); without images, all on one
        device."""
        rows, frames = index[:, None], first[:, None] + torch.arange(steps + 1, device=first.device)
        return LatentEpisodes(
            self.images[:0], self.latents[rows, frames], self.mean_change_S, self.states[rows, frames],
            self.actions[rows, frames[:, :-1]], self.success[rows, frames], self.labelled[index],
            self.truth[rows, frames], self.step_mask[rows, frames[:, :-1]],
        )


def tokenise_episodes(tokenizer: Tokenizer, episodes: EpisodeArrays) -> LatentEpisodes:
    """Encode every frame once; all but the images, a thousand times the rest, then lie on the tokenizer's device."""
    device = tokenizer.device
    flat = episodes.images.reshape(-1, *episodes.images.shape[2:])
    pieces = [tokenizer.encode(flat[i : i + ENCODING_BATCH]).half() for i in range(0, len(flat), ENCODING_BATCH)]
    latents = torch.cat(pieces).clone().reshape(*episodes.images.shape[:2], *pieces[0].shape[1:])
    change = (latents[:, 1:].float() - latents[:, :1].float()).abs().mean(-1).mean((0, 1))
    return LatentEpisodes(
        images=torch.from_numpy(episodes.images), latents=latents, mean_change_S=change,
        states=torch.from_numpy(episodes.states).to(device), actions=torch.from_numpy(episodes.actions).to(device),
        success=torch.from_numpy(episodes.success).to(device),
        truth=torch.from_numpy(probed_targets(episodes, states=tokenizer.num_positions > 0)).to(device),
        labelled=torch.from_numpy(episodes.labelled).to(device),
        step_mask=torch.from_numpy(episodes.step_mask).to(device),
    )


def tool_moves(data: LatentEpisodes) -> Tensor:
    """Bool (E, T), the recorded steps that change the state; all of an episode that has none."""
    moves = ((data.states[:, 1:] - data.states[:, :-1]).abs() > MOVED).any(-1) & data.step_mask
    return torch.where(moves.any(1, keepdim=True), moves, data.step_mask)


def first_frames(lengths: Tensor, moves: Tensor, num_steps: int, generator: torch.Generator) -> Tensor:
    """(B,), a random frame of each of B episodes of `lengths` steps from which num_steps more were recorded; 0 where
    there is none. moves: tool_moves of the episodes (B, T).

    MOVING_SHARE of the parts hold a random step of which the tool moves: an episode that has succeeded long before its
    end stands still for most of its time.
    """
    last = (lengths - num_steps).clamp(min=0)
    share, anywhere, before = torch.rand(3, len(lengths), generator=generator)
    step = torch.multinomial(moves.float(), 1, generator=generator)[:, 0]
    around = (step - (before * num_steps).long()).clamp(min=0)
    return torch.where(share < MOVING_SHARE, torch.minimum(around, last), (anywhere * (last + 1)).long())
