"""What each pixel shows: scene, robot, the named object, clutter (RA-17). A U-Net.

Shapes: N images, H W 3 image, C classes, in the order of the masks of judge/dataset. Trained on simulator masks by
wm_nodes/judge/training/train.py.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wm_nodes.core.types import UInt8Array

SCENE, ROBOT, OBJECT, CLUTTER = range(4)
NUM_CLASSES = 4
CHANNELS = (12, 24, 48)
"""At a half, a quarter and an eighth of the picture."""
MULTIPLE_PX = 8
BATCH = 64
SQUARE = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Row and column of the pixels that are folded into one place, in the order of pixel_unshuffle."""


class Segmenter(nn.Module):
    """A small U-Net: 0.07 million weights, about 20 million multiplications for a picture of 96 x 96."""

    def __init__(self) -> None:
        super().__init__()
        half, quarter, eighth = CHANNELS
        self.first = _block(12, half, 1)
        self.second = nn.Sequential(_block(half, quarter, 2), _block(quarter, quarter, 1))
        self.third = nn.Sequential(_block(quarter, eighth, 2), _block(eighth, eighth, 1), _block(eighth, eighth, 1))
        self.up_second, self.up_first = nn.Conv2d(eighth, quarter, 1), nn.Conv2d(quarter, half, 1)
        self.join_second, self.join_first = _block(quarter, quarter, 1), _block(half, half, 1)
        self.out = nn.Conv2d(half, 4 * NUM_CLASSES, 1)

    def forward(self, pixels_N3HW: Tensor) -> Tensor:
        """Logits (N, C, H, W); pixels float in [0, 1], H and W multiples of MULTIPLE_PX."""
        return F.pixel_shuffle(self._folded_logits(F.pixel_unshuffle(2 * pixels_N3HW - 1, 2)), 2)

    def _folded_logits(self, folded: Tensor) -> Tensor:
        """Logits (N, 4 C, H / 2, W / 2), the four pixels of a square side by side, of pixels in [-1, 1] as such."""
        first = self.first(folded)
        second = self.second(first)
        third = self.third(second)
        second = self.join_second(second + F.interpolate(self.up_second(third), scale_factor=2.0))
        first = self.join_first(first + F.interpolate(self.up_first(second), scale_factor=2.0))
        logits: Tensor = self.out(first)
        return logits

    @torch.inference_mode()
    def masks(self, images: UInt8Array) -> UInt8Array:
        """The likeliest class of each pixel, uint8 (N, H, W), of uint8 images (N, H, W, 3) of any size."""
        height, width = images.shape[1:3]
        padding = ((0, 0), (0, -height % MULTIPLE_PX), (0, -width % MULTIPLE_PX), (0, 0))
        device = self.out.weight.device
        parts = [
            _unfold(_argmax(self._folded_logits(_fold(np.pad(images[start : start + BATCH], padding, "edge"), device))))
            for start in range(0, len(images), BATCH)
        ]
        return np.concatenate(parts)[:, :height, :width]


def _block(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.ReLU(inplace=True))


def _fold(images: UInt8Array, device: torch.device) -> Tensor:
    """pixel_unshuffle by 2 of 2 x / 255 - 1, float (N, 12, H / 2, W / 2). Bytes are moved in a quarter of the time."""
    count, height, width = images.shape[:3]
    folded = np.empty((count, 3, 2, 2, height // 2, width // 2), np.float32)
    for row, column in SQUARE:
        folded[:, :, row, column] = images[:, row::2, column::2].transpose(0, 3, 1, 2)
    pixels = torch.from_numpy(folded.reshape(count, 12, height // 2, width // 2)).to(device)
    return pixels.div_(255).mul_(2).sub_(1).contiguous(memory_format=torch.channels_last)  # convolutions are faster


def _unfold(labels: Tensor) -> UInt8Array:
    """pixel_shuffle by 2, uint8 (N, H, W), of (N, 4, H / 2, W / 2)."""
    count, _, height, width = labels.shape
    images, values = np.empty((count, height, 2, width, 2), np.uint8), labels.cpu().numpy()
    for place, (row, column) in enumerate(SQUARE):
        images[:, :, row, :, column] = values[:, place]
    return images.reshape(count, 2 * height, 2 * width)


def _argmax(folded_logits: Tensor) -> Tensor:
    """argmax over classes, uint8 (N, 4, H / 2, W / 2); the first of equals. Tensor.argmax is far slower."""
    count, _, height, width = folded_logits.shape
    logits = folded_logits.contiguous().view(count, NUM_CLASSES, 4, height, width)
    low, high = torch.maximum(logits[:, 0], logits[:, 1]), torch.maximum(logits[:, 2], logits[:, 3])
    of_low, of_high = (logits[:, k + 1] > logits[:, k] for k in (0, 2))
    return torch.where(high > low, of_high.to(torch.uint8) + 2, of_low.to(torch.uint8))
