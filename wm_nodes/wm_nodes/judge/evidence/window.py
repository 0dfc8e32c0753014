"""The part of a picture that a judge reads, at the size that its evidence is measured at."""

from dataclasses import dataclass

import cv2
import numpy as np

from wm_nodes.core.types import FloatArray, UInt8Array


@dataclass(frozen=True)
class Window:
    """Columns first to end - 1 of pictures of height x width px, scaled to side x side px."""

    height: int
    width: int
    first: int
    end: int
    side: int

    def pictures(self, pictures: UInt8Array) -> UInt8Array:
        """uint8 (..., side, side, 3) of pictures (..., height, width, 3). Raises ValueError: another size."""
        if pictures.shape[-3:] != (self.height, self.width, 3):
            raise ValueError(f"pictures must be {self.height} x {self.width} px of 3 colours, got {pictures.shape}")
        return self._scale(pictures[..., self.first : self.end, :], cv2.INTER_CUBIC)

    def masks(self, masks: UInt8Array) -> UInt8Array:
        """uint8 (T, side, side) of masks (T, height, end - first) of the window's columns."""
        return self._scale(masks[..., None], cv2.INTER_NEAREST)[..., 0]

    def track(self, track: FloatArray) -> FloatArray:
        """Rows and columns (T, 2) in px of the columns' own picture, in px of the scaled one."""
        scale = np.array([self.side / self.height, self.side / (self.end - self.first)], np.float32)
        moved: FloatArray = (track + np.float32(0.5)) * scale - np.float32(0.5)
        return moved

    def _scale(self, pictures: UInt8Array, interpolation: int) -> UInt8Array:
        flat = np.ascontiguousarray(pictures).reshape(-1, *pictures.shape[-3:])
        size = (self.side, self.side)
        scaled = np.stack([cv2.resize(picture, size, interpolation=interpolation) for picture in flat])
        shaped: UInt8Array = scaled.reshape(*pictures.shape[:-3], *size, pictures.shape[-1])
        return shaped
