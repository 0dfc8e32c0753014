"""A clip's pixels and what several kinds of evidence read off them (RA-17).

Shapes: T frames, H W 3 image, G grid cells along each side.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import UInt8Array

GRID = 48
"""Frames are averaged to GRID x GRID cells for colour and motion, so that their size does not matter."""
TURN = np.exp(2j * np.pi / 3 * np.arange(3)).astype(np.complex64)
"""Chroma is r + g exp(2 pi i / 3) + b exp(4 pi i / 3): its angle is the hue, its length the colourfulness."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ClipPictures:
    """A clip with its reference frame before it.

    colours: uint8 (1 + T, H, W, 3). greys: uint8 (1 + T, H, W). cells: float32 (1 + T, G, G, 3), levels. planes: the
    same as (3, 1 + T, G, G), as means over colours are quick there. away: float32 (T, G, G), mean absolute difference
    of cells from the reference frame's.
    """

    colours: UInt8Array
    greys: UInt8Array
    cells: Floats
    planes: Floats
    away: Floats


def pictures_of(frames: UInt8Array, reference: UInt8Array) -> ClipPictures:
    """Average a clip. frames: uint8 (T, H, W, 3), T >= 2. reference: uint8 (H, W, 3), what the clip had to start from.

    Raises:
        ValueError: wrong shapes or types; names them.
    """
    check_clip(frames, reference)
    colours = np.concatenate([reference[None], frames])
    greys = np.stack([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in colours])
    cells = np.stack([shrink(picture, GRID) for picture in colours])
    planes = np.ascontiguousarray(cells.transpose(3, 0, 1, 2))
    return ClipPictures(colours, greys, cells, planes, np.abs(planes[:, 1:] - planes[:, :1]).mean(0))


def check_clip(frames: UInt8Array, reference: UInt8Array) -> None:
    """Raise ValueError unless frames are uint8 (T >= 2, H, W, 3) and reference is one of that size."""
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or len(frames) < 2:
        raise ValueError(f"frames must be uint8 (T >= 2, H, W, 3), got {frames.dtype} {frames.shape}")
    if reference.dtype != np.uint8 or reference.shape != frames.shape[1:]:
        raise ValueError(
            f"the reference frame must be uint8 {frames.shape[1:]}, got {reference.dtype} {reference.shape}"
        )


def shrink(image: NDArray[np.generic], side: int) -> Floats:
    """(side, side, C) float32; area means where the image is larger."""
    cells: Floats = cv2.resize(image.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)
    return cells
