"""Reads positions off pictures, to measure a world model. Shapes: B images, H W 3 image, P positions.

It shares no weights and no layers with the world model, is trained on recorded images only, and is part of no loss of
the world model, which therefore cannot learn to exploit it.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.world_model.tokenizer import NUM_POSITIONS

CHANNELS = (24, 48, 64, 64)
HIDDEN = 128
BATCH = 256


class PictureReader(nn.Module):
    """A network that reads values off pictures of the cameras that it was trained on, of any size."""

    def __init__(self, height: int, width: int) -> None:
        super().__init__()
        self.height, self.width = height, width

    @torch.inference_mode()
    def read_values(self, images: UInt8Array | Tensor) -> Tensor:
        """What forward gives for each of uint8 images (..., H, W, 3), (N, ...), N all of them.

        Raises:
            ValueError: images of another shape.
        """
        tensor = torch.as_tensor(images)
        H, W, channels = tensor.shape[-3:]
        if channels != 3 or H * self.width != W * self.height:
            raise ValueError(
                f"images must be (..., {self.height}, {self.width}, 3) or enlarged, got {tuple(tensor.shape)}; the "
                f"{type(self).__name__} was trained for another camera set-up, see the model folder's manifest"
            )
        parts = torch.split(tensor.reshape(-1, H, W, 3), BATCH)  # type: ignore[no-untyped-call]
        return torch.cat([self(self.pixels(part)) for part in parts])

    def pixels(self, images: Tensor) -> Tensor:
        """Float (B, 3, height, width) in [0, 1]."""
        pixels = images.permute(0, 3, 1, 2).to(next(self.parameters()).device).float() / 255
        if tuple(pixels.shape[2:]) == (self.height, self.width):
            return pixels
        return interpolate(pixels, (self.height, self.width), mode="bilinear", antialias=True)


class PositionProbe(PictureReader):
    """A small convolutional regressor, without pooling, so that places stay places."""

    def __init__(self, height: int, width: int, num_positions: int = NUM_POSITIONS) -> None:
        super().__init__(height, width)
        layers, values = halving_convolutions(CHANNELS, height, width)
        self.features = nn.Sequential(*layers)
        self.regress = nn.Sequential(nn.Linear(values, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, num_positions))
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", torch.zeros(num_positions))
        self.register_buffer("std", torch.ones(num_positions))

    def forward(self, pixels_B3HW: Tensor) -> Tensor:
        """Positions (B, P) with zero mean and unit variance over the data; pixels float in [0, 1]."""
        out: Tensor = self.regress(self.features(2 * pixels_B3HW - 1))
        return out

    def read(self, images: UInt8Array | Tensor) -> FloatArray:
        """Positions (..., P), m, of uint8 images (..., H, W, 3). Raises ValueError as read_values."""
        positions = self.read_values(images) * self.std + self.mean
        found: FloatArray = positions.cpu().numpy().reshape(*images.shape[:-3], -1).astype(np.float32)
        return found


def halving_convolutions(channels: Sequence[int], height: int, width: int) -> tuple[list[nn.Module], int]:
    """Layers of pictures (B, 3, height, width), whose sides each convolution halves, and how many values they give."""
    layers: list[nn.Module] = []
    for before, after in pairwise((3, *channels)):
        layers += [nn.Conv2d(before, after, 5, stride=2, padding=2), nn.SiLU()]
    rows, columns = (-(-size // 2 ** len(channels)) for size in (height, width))
    return [*layers, nn.Flatten()], channels[-1] * rows * columns
