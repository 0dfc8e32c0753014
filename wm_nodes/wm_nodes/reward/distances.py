"""Perceptual distances between images: zero for equal images, symmetric, 0.5 to 1 for a typical start and goal.
Shapes: N pairs, H W 3 image, F features.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from wm_nodes.types import FloatArray, UInt8Array


class Distance(Protocol):
    """Perc(a, b): uint8 (N, H, W, 3) twice -> float32 (N,), >= 0. `name` tells which one judged."""

    @property
    def name(self) -> str: ...

    def __call__(self, images: UInt8Array, others: UInt8Array) -> FloatArray: ...


class _PixelL1:
    name = "pixel_l1"

    def __call__(self, images: UInt8Array, others: UInt8Array) -> FloatArray:
        """Mean absolute difference of the pixels, [0, 1]."""
        check_pair(images, others)
        difference = np.abs(images.astype(np.int16) - others.astype(np.int16))
        mean: FloatArray = (difference.reshape(len(images), -1).mean(1, dtype=np.float64) / 255).astype(np.float32)
        return mean


pixel_l1: Distance = _PixelL1()


@dataclass(frozen=True)
class EncoderDistance:
    """Mean absolute difference of encoder features, divided by `scale`.

    encoder: uint8 tensor (N, H, W, 3) -> (N, F). scale: the distance that counts as 1, see `calibrated`.
    identity: names the encoder, e.g. the start of its sha256.
    """

    encoder: Callable[[Tensor], Tensor]
    scale: float = 1.0
    identity: str = ""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale must be finite and > 0, got {self.scale}; calibrate on differing images")

    @classmethod
    def calibrated(
        cls, encoder: Callable[[Tensor], Tensor], starts: UInt8Array, goals: UInt8Array, identity: str = ""
    ) -> "EncoderDistance":
        """Scale such that the mean distance from starts to goals, uint8 (N, H, W, 3), is 1."""
        return cls(encoder, float(cls(encoder)(starts, goals).mean()), identity)

    @property
    def name(self) -> str:
        return f"encoder:{self.identity}:{self.scale:.6g}"

    def __call__(self, images: UInt8Array, others: UInt8Array) -> FloatArray:
        check_pair(images, others)
        with torch.no_grad():
            first_NF, second_NF = (
                self.encoder(torch.from_numpy(np.ascontiguousarray(batch))).float() for batch in (images, others)
            )
            distance_N = (first_NF - second_NF).abs().flatten(1).mean(1) / self.scale
        return distance_N.cpu().numpy()


def check_pair(images: UInt8Array, others: UInt8Array) -> None:
    """Raise ValueError unless both are uint8 (N, H, W, 3) of one shape."""
    if images.dtype != np.uint8 or others.dtype != np.uint8 or images.shape != others.shape or images.ndim != 4:
        raise ValueError(
            f"a distance needs two uint8 (N, H, W, 3) arrays of one shape, got {images.dtype} {images.shape} and "
            f"{others.dtype} {others.shape}"
        )
