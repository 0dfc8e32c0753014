"""What moves in a clip and what does not, from its pixels. Shapes: T frames, H W 3 image.

No view, mask or name is known. The scenery is what the places where something moves show at some time and what fits
best to the places where nothing ever does. In a view whose camera moves nearly everything moves.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from wm_nodes.core.types import BoolArray, UInt8Array

LEAST_CHANGE = 20.0
"""A pixel moves where a channel changes by more, of 255; more in noisy clips."""
NOISES = 6.0
"""And by more than so many median changes between neighbouring frames."""
LEAST_CHROMA = 40
"""Pixels with less between their strongest and weakest channel have no hue."""
HUE_WIDTH = 12
"""Hues of one object lie within this distance of a middle one, of 180."""
LEAST_OBJECT, LARGEST_OBJECT = 0.0006, 0.08
"""Areas of an object, as shares of the picture."""
KERNEL = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class Scene:
    """A clip and its regions."""

    frames: UInt8Array
    """uint8 (T, H, W, 3)."""
    scenery: UInt8Array
    """uint8 (H, W, 3), the picture without what moves."""
    moving: BoolArray
    """(T, H, W), what differs from the scenery."""
    object_mask: BoolArray
    """(T, H, W), the object in all views; nowhere True where no small moving region of one hue is found."""
    end: int
    """Frame after which nothing moves any more, >= 1."""

    @property
    def short_px(self) -> int:
        """The shorter side of the picture."""
        return min(self.scenery.shape[:2])


def scene_of(frames: UInt8Array) -> Scene:
    """Find the regions of a clip, uint8 (T, H, W, 3), T >= 2."""
    signed = frames.astype(np.int16)
    steps = np.abs(np.diff(signed, axis=0))
    least = max(LEAST_CHANGE, NOISES * float(np.median(steps)))
    ever = np.ptp(frames, axis=0).max(-1) > least
    fitting = cv2.inpaint(frames[0], cv2.dilate(ever.astype(np.uint8), KERNEL), 3, cv2.INPAINT_TELEA)
    nearest = np.abs(signed - fitting).sum(-1).argmin(0)
    scenery = np.take_along_axis(frames, nearest[None, ..., None], 0)[0]
    moving = (np.abs(signed - scenery).max(-1) > least).astype(np.uint8)
    closed = np.stack([cv2.morphologyEx(each, cv2.MORPH_CLOSE, KERNEL) for each in moving]) > 0
    active = np.flatnonzero((steps.max(-1) > least).mean((1, 2)) > LEAST_OBJECT)
    return Scene(frames, scenery, closed, _object(frames, ever), int(active[-1]) + 1 if len(active) else 1)


def _object(frames: UInt8Array, ever: BoolArray) -> BoolArray:
    """The largest region of one hue that is small in every frame, seen in most, and mostly where something moves."""
    hue = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2HSV)[..., 0] for frame in frames]).astype(np.int16)
    coloured = np.ptp(frames, axis=-1) >= LEAST_CHROMA
    best, largest = np.zeros(hue.shape, np.bool_), 0
    for middle in range(0, 180, HUE_WIDTH // 2):
        found = coloured & (np.abs((hue - middle + 90) % 180 - 90) <= HUE_WIDTH)
        areas = found.sum((1, 2))
        seen = areas >= max(4, LEAST_OBJECT * ever.size)
        small = seen.mean() >= 0.7 and areas.max() <= LARGEST_OBJECT * ever.size
        if small and found[:, ever].sum() >= 0.6 * areas.sum() and areas.sum() > largest:
            best, largest = found, int(areas.sum())
    return best
