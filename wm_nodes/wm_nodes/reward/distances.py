"""Perceptual distances between images (RS-5a): zero for equal images, symmetric, 0.5 to 1 for a typical start and goal.
Shapes: N pairs, H W 3 image, F features.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from wm_nodes.core.types import FloatArray, UInt8Array

CACHED_IMAGES = 1024
BATCH = 32


class Distance(Protocol):
    """Perc(a, b): uint8 (N, H, W, 3) twice -> float32 (N,), >= 0. `name` identifies it."""

    @property
    def name(self) -> str: ...

    def __call__(self, images: UInt8Array, others: UInt8Array) -> FloatArray: ...


@dataclass(frozen=True)
class EncoderDistance:
    """Mean absolute difference of encoder features, divided by `scale`.

    Features of the last CACHED_IMAGES images are kept: goals come back every step, and one step's image is the next
    step's first.
    """

    encoder: Callable[[Tensor], Tensor]
    """uint8 tensor (N, H, W, 3) -> (N, F)."""
    scale: float = 1.0
    """The distance that counts as 1."""
    identity: str = ""
    """Names the encoder, e.g. the start of its sha256."""
    _known: dict[bytes, Tensor] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale must be finite and > 0, got {self.scale}")

    @property
    def name(self) -> str:
        return f"encoder:{self.identity}:{self.scale:.6g}"

    def __call__(self, images: UInt8Array, others: UInt8Array) -> FloatArray:
        check_pair(images, others)
        return self.between(self._features(images), self._features(others)).cpu().numpy()

    def between(self, features: Tensor, others: Tensor) -> Tensor:
        """The distance (...,) of features (..., F), as encode gives them."""
        return (features - others).abs().mean(-1) / self.scale

    @torch.no_grad()
    def _features(self, images: UInt8Array) -> Tensor:
        keys = [hashlib.blake2b(image.tobytes(), digest_size=16).digest() for image in images]
        new = list({key: index for index, key in enumerate(keys) if key not in self._known}.items())
        if new:
            for (key, _), feature in zip(new, self.encode(images[[index for _, index in new]]), strict=True):
                self._known[key] = feature
        features = torch.stack([self._known[key] for key in keys])
        for key in list(self._known)[: max(0, len(self._known) - CACHED_IMAGES)]:
            del self._known[key]
        return features

    @torch.no_grad()
    def encode(self, images: UInt8Array) -> Tensor:
        """Features float32 (N, F), in batches of one size, the last one filled up: those of an image do not depend on
        how many others were new, and a recorded reward is computed again bit by bit."""
        missing = -len(images) % BATCH
        filled = np.concatenate([images, np.zeros((missing, *images.shape[1:]), np.uint8)])
        parts = [self.encoder(torch.from_numpy(filled[i : i + BATCH])).float() for i in range(0, len(filled), BATCH)]
        return torch.cat(parts)[: len(images)].flatten(1)


def check_pair(images: UInt8Array, others: UInt8Array) -> None:
    """Raise ValueError unless both are uint8 (N, H, W, 3) of one shape."""
    if images.dtype != np.uint8 or others.dtype != np.uint8 or images.shape != others.shape or images.ndim != 4:
        raise ValueError(
            f"a distance needs two uint8 (N, H, W, 3) arrays of one shape, got {images.dtype} {images.shape} and "
            f"{others.dtype} {others.shape}"
        )
