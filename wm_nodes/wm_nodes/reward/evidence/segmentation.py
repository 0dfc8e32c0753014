"""What each pixel shows: scene, robot, the named object, clutter. Specification: section 4.3 (U-Net masks).

Shapes: N images, H W 3 image, C classes, in the order of the masks of reward/adversarial. Trained on simulator masks by
wm_nodes/learning/judge_training.py.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wm_nodes.types import UInt8Array

SCENE, ROBOT, OBJECT, CLUTTER = range(4)
NUM_CLASSES = 4
CHANNELS = (12, 24, 48)
"""At a half, a quarter and an eighth of the picture."""
MULTIPLE_PX = 8
BATCH = 64


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
        first = self.first(F.pixel_unshuffle(2 * pixels_N3HW - 1, 2))
        second = self.second(first)
        third = self.third(second)
        second = self.join_second(second + F.interpolate(self.up_second(third), scale_factor=2.0))
        first = self.join_first(first + F.interpolate(self.up_first(second), scale_factor=2.0))
        logits: Tensor = F.pixel_shuffle(self.out(first), 2)
        return logits

    @torch.inference_mode()
    def masks(self, images: UInt8Array) -> UInt8Array:
        """The likeliest class of each pixel, uint8 (N, H, W), of uint8 images (N, H, W, 3) of any size."""
        height, width = images.shape[1:3]
        padding = (0, -width % MULTIPLE_PX, 0, -height % MULTIPLE_PX)
        parts = []
        for start in range(0, len(images), BATCH):
            pixels = torch.from_numpy(np.ascontiguousarray(images[start : start + BATCH]))
            padded = F.pad(pixels.permute(0, 3, 1, 2).float() / 255, padding, mode="replicate")
            parts.append(_likeliest(self(padded)[..., :height, :width]))
        found: UInt8Array = torch.cat(parts).numpy()
        return found


def _block(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.ReLU(inplace=True))


def _likeliest(logits: Tensor) -> Tensor:
    """argmax over classes, uint8 (N, H, W); the first of equals. Several times as fast as Tensor.argmax here."""
    best, label = logits[:, 0], torch.zeros_like(logits[:, 0], dtype=torch.uint8)
    for index in range(1, NUM_CLASSES):
        label.masked_fill_(logits[:, index] > best, index)
        best = torch.maximum(best, logits[:, index])
    return label
