"""What a video is generated from.

Shapes: B batch, C channels, K given frames, F frames, H W grid, A action values, L text tokens of E values.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from wm_nodes.core.seeding import torch_stream


@dataclass(frozen=True)
class Condition:
    """What B videos are made of."""

    frames: Tensor
    """Clean latents of the first K >= 0 frames (B, C, K, H, W)."""
    actions: Tensor
    """(B, F - 1, A), action f leads from frame f to frame f + 1; A = 0 where they are hidden and the model chooses the
    motion."""
    text: Tensor
    """(B, L, E) embedded instruction; E and L may be 0."""

    @property
    def num_conditioning(self) -> int:
        return self.frames.shape[2]

    def rows(self, index: Tensor | slice) -> "Condition":
        return Condition(self.frames[index], self.actions[index], self.text[index])

    def to(self, device: torch.device | str) -> "Condition":
        return Condition(self.frames.to(device), self.actions.to(device), self.text.to(device))

    def without_actions(self) -> "Condition":
        return Condition(self.frames, self.actions[:, :, :0], self.text)

    def without_frames(self) -> "Condition":
        return Condition(self.frames[:, :, :0], self.actions, self.text)

    def repeat_interleave(self, times: int) -> "Condition":
        """Each row `times` times, in groups."""
        return Condition(*(tensor.repeat_interleave(times, 0) for tensor in (self.frames, self.actions, self.text)))


def hashed_words(texts: Sequence[str], size: int) -> Tensor:
    """Return an embedding of instructions that needs no weights, (B, L, size): each word's own fixed random vector.

    Shorter texts are padded with zeros; case does not matter. Equal words have equal vectors everywhere.
    """
    words = [text.lower().split() for text in texts]
    rows = torch.zeros(len(texts), max([1, *map(len, words)]), size)
    for row, text in zip(rows, words, strict=True):
        for place, word in enumerate(text):
            row[place] = torch.randn(size, generator=torch_stream(0, f"word {word}"))
    return rows
