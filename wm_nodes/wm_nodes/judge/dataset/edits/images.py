"""Image kernels of the recipes. NumPy only, elementwise and in one order: the same bytes on every machine, which a
manifest of hashes needs and image libraries do not promise (RA-21).

Shapes: T frames, H W C image, float32 grey levels 0 to 255.
"""

import math

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array

Images = NDArray[np.float32]
KERNEL_STEPS = 4096
"""Kernel weights are multiples of 1 / KERNEL_STEPS, so that a last bit of exp cannot matter."""


def to_uint8(images: Images) -> UInt8Array:
    """Round and clip to 0..255."""
    return np.clip(np.rint(images), 0, 255).astype(np.uint8)


def blur(images: Images, sigma_px: float) -> Images:
    """Gaussian blur over H and W of (T, H, W, C); the border is repeated outwards."""
    radius = max(1, math.ceil(3 * sigma_px))
    steps = np.arange(-radius, radius + 1)
    weights = np.rint(KERNEL_STEPS * np.exp(-(steps**2) / (2 * sigma_px**2)))
    weights = (weights / weights.sum()).astype(np.float32)
    for axis in (1, 2):
        padding = [(0, 0)] * images.ndim
        padding[axis] = (radius, radius)
        padded, size = np.pad(images, padding, mode="edge"), images.shape[axis]
        images = sum(
            (weight * padded.take(range(i, i + size), axis) for i, weight in enumerate(weights)),
            start=np.zeros_like(images),
        )
    return images


def blur_within(images: Images, mask: BoolArray, sigma_px: float) -> Images:
    """Blur (T, H, W, C) as if there were nothing outside of `mask` (T, H, W); unchanged outside of it."""
    inside = mask[..., None].astype(np.float32)
    spread = blur(images * inside, sigma_px) / np.maximum(blur(inside, sigma_px), 1e-6)
    return np.where(mask[..., None], spread, images)


def turn_hue(images: Images, degrees: float) -> Images:
    """Rotate colours about the grey axis; greys stay."""
    cos, sin = round(math.cos(math.radians(degrees)), 6), round(math.sin(math.radians(degrees)), 6)
    same, up, down = (np.float32(x) for x in (
        cos + (1 - cos) / 3, (1 - cos) / 3 - sin / math.sqrt(3), (1 - cos) / 3 + sin / math.sqrt(3),
    ))
    r, g, b = np.moveaxis(images, -1, 0)
    return np.stack([same * r + up * g + down * b, down * r + same * g + up * b, up * r + down * g + same * b], axis=-1)


def plate(frames: UInt8Array, scenery: BoolArray) -> Images:
    """The scene without what moves in it, (H, W, 3): the mean over frames of the pixels where `scenery` (T, H, W)
    holds; a pixel that is never free is filled from around it.
    """
    count = scenery.sum(0)
    total = (frames * scenery[..., None]).sum(0, dtype=np.int64)
    known = count > 0
    image: Images = (total / np.maximum(count, 1)[..., None]).astype(np.float32)
    if not known.any():
        raise ValueError("no frame shows any background; give a clip in which the robot does not fill the view")
    while not known.all():
        weight = blur(known[None, :, :, None].astype(np.float32), 2.0)[0]
        near = blur((image * known[..., None])[None], 2.0)[0] / np.maximum(weight, 1e-6)
        fresh = (weight[..., 0] > 1e-3) & ~known
        image[fresh] = near[fresh]
        known |= fresh
    return image


def sample(image: NDArray[np.float32], rows: FloatArray, columns: FloatArray) -> Images:
    """Read (H, W, C) at positions (H, W) in px, bilinear; the border is repeated outwards."""
    height, width = image.shape[:2]
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    top, left = np.floor(rows).astype(int), np.floor(columns).astype(int)
    bottom, right = np.minimum(top + 1, height - 1), np.minimum(left + 1, width - 1)
    down, across = (rows - top)[..., None], (columns - left)[..., None]
    upper = image[top, left] * (1 - across) + image[top, right] * across
    lower = image[bottom, left] * (1 - across) + image[bottom, right] * across
    read: Images = upper * (1 - down) + lower * down
    return read


def disc(centre: tuple[float, float], radius_px: float, height: int, width: int) -> FloatArray:
    """Opacity (H, W): 1 inside half the radius, falling linearly to 0 at the radius."""
    rows, columns = np.indices((height, width), np.float32)
    distance = np.sqrt((rows - centre[0]) ** 2 + (columns - centre[1]) ** 2)
    opacity: FloatArray = np.clip(2 - 2 * distance / radius_px, 0, 1).astype(np.float32)
    return opacity
