"""Numbers of a clip's pictures: what is seen, what appears, vanishes or moves by itself (RA-27).

Nothing is known of the scene: a view's commonest colour is taken for its surface, what is far from it for things, each
saturated hue for one thing, and what is far and grey for the robot. Larger always means stranger.
Shapes: T frames, H W 3 image, N coloured things.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, UInt8Array

Floats = NDArray[np.float64]
Greys = NDArray[np.float32]

HUES: Mapping[str, tuple[int, int]] = {
    "red": (340, 20), "orange": (20, 42), "yellow": (42, 70), "green": (70, 165), "cyan": (165, 200),
    "blue": (200, 262), "purple": (262, 340),
}
"""Colour words, and from which to which angle of the colour circle they are meant."""
FAR = 28
"""Grey levels in one channel from which a pixel is not of the surface."""
GREY, SATURATED = 45, 40
"""Difference of a pixel's largest and smallest channel: below, it may be of the robot; above, of a thing."""
SMALLEST_PX = 5
"""Pixels that a coloured thing has at least."""
TOUCH_PX, ALONE_PX = 4.0, 8.0
"""A thing whose nearest robot pixel is nearer than the first may be moved; farther than the second, it moves alone."""
NO_ROBOT_PX = 64.0
"""Distance of everything to a robot that is not seen."""
RIM_PX = 2
"""Rows at the top of a picture in which no robot is looked for."""
LEAST_SCENERY_PX = 50
"""Pixels of the scenery that its number needs; it is 0 of fewer."""
FAINT, FULL = 0.2, 0.5
"""Share of a thing's colour below which a pixel shows none of it; from which it is of the thing."""
NEAR = 8.0
"""A thing is wholly seen where a moving camera shows so many times what the still one showed at the start."""
LEAST_MIDDLE_PX, LEAST_SHAPE_PX = 4, 6
"""Pixels that a place needs, and that a shape needs."""

COMPONENTS: Mapping[str, str] = {
    "blurred": "clarity", "thing_blurred": "clarity", "light": "brightness", "tint": "color",
    "scenery": "background", "stranger": "background",
    "start": "objective", "thing_lost_alone": "objective", "thing_end": "objective",
    "robot_least": "robot",
    "thing_moves_alone": "interaction", "thing_far_of_robot": "interaction",
    "thing_gained_alone": "deformation", "thing_shape": "deformation", "thing_long": "deformation",
}
"""Each number, and the component of the rubric that it speaks about."""


def picture_numbers(frames: UInt8Array, reference: UInt8Array, width: int, still: tuple[bool, ...]) -> dict[str, float]:
    """Return the numbers of COMPONENTS.

    Args:
        frames: uint8 (T, H, W, 3), T >= 2, the views side by side. reference: (H, W, 3), what the clip starts from.
        width: of one view, px. still: whether each view's camera stands still.
    """
    views = [slice(first, first + width) for first in range(0, frames.shape[2], width)]
    parts = [_view(frames[:, :, view], reference[:, view], stays) for view, stays in zip(views, still, strict=True)]
    numbers = {name: max(part[name] for part in parts if name in part) for name in {n for p in parts for n in p}}
    if any(still):
        numbers |= _colours(np.concatenate([reference[None], frames]), views, still)
    return {name: numbers.get(name, 0.0) for name in COMPONENTS}


def hue_masks(pictures: UInt8Array) -> BoolArray:
    """Saturated pixels of each hue, (len(HUES), ..., H, W) of (..., H, W, 3)."""
    x = pictures.astype(np.int16)
    top, span = x.max(-1), x.max(-1) - x.min(-1)
    r, g, b = np.moveaxis(x.astype(np.float32), -1, 0)
    wide = np.maximum(span, 1).astype(np.float32)
    not_red = np.where(top == x[..., 1], (b - r) / wide + 2, (r - g) / wide + 4)
    angle = 60 * np.where(top == x[..., 0], ((g - b) / wide) % 6, not_red)
    seen = (span > SATURATED) & (span > 0.35 * top)
    return np.stack([
        seen & ((angle >= low) & (angle < high) if low < high else (angle >= low) | (angle < high))
        for low, high in HUES.values()
    ])


def things_in(picture: UInt8Array) -> dict[str, int]:
    """Pixels of each colour that is not the surface's, of one view (H, W, 3); those of SMALLEST_PX or more."""
    x = picture[None]
    areas = (hue_masks(x) & _far(x, picture)).sum((1, 2, 3))
    return {name: int(area) for name, area in zip(HUES, areas) if area >= SMALLEST_PX}


def _far(frames: UInt8Array, reference: UInt8Array) -> BoolArray:
    surface = np.median(reference.reshape(-1, 3), 0)
    return np.asarray(np.abs(frames.astype(np.int16) - surface).max(-1) > FAR)


def _view(frames: UInt8Array, reference: UInt8Array, still: bool) -> dict[str, float]:
    """Numbers of one view."""
    every = np.concatenate([reference[None], frames])
    grey = every.astype(np.float32).mean(-1)
    numbers = {"blurred": _blurred(grey, still)}
    if still:
        numbers |= _light(grey, every) | _still_view(every)
    return {name: float(value) for name, value in numbers.items()}


def _blurred(grey: Greys, still: bool) -> float:
    """How few edges the least sharp frame has. grey: (T + 1, H, W), of the reference and the frames; likewise below."""
    rows, columns = grey[:, :, 1:-1], grey[:, 1:-1]
    laplace = 4 * columns[:, :, 1:-1] - rows[:, :-2] - rows[:, 2:] - columns[:, :, :-2] - columns[:, :, 2:]
    laplace = np.abs(laplace).reshape(len(grey), -1)
    edges = np.sort(laplace, 1)[:, -laplace[0].size // 20 :].mean(1)  # of the sharpest 5 %
    return float(-(edges[1:] / (edges[0] + 1)).min() if still else -edges[1:].min() / (edges[1:].mean() + 1))


def _light(grey: Greys, every: UInt8Array) -> dict[str, float]:
    """Numbers of how far the mean level and colour are from the reference's."""
    light = grey.mean((1, 2))
    tint = every.astype(np.float32).mean((1, 2)) / (light[:, None] + 1)
    return {"light": np.abs(light[1:] - light[0]).max(), "tint": np.abs(tint[1:] - tint[0]).max()}


def _still_view(every: UInt8Array) -> dict[str, float]:
    """Numbers that need a camera that stands still. every: (T + 1, H, W, 3), the reference, then the frames."""
    far = _far(every, every[0])
    hues = hue_masks(every) & far
    span = every.max(-1).astype(np.int16) - every.min(-1)
    robots = far & (span < GREY) & ~hues.any(0)
    robots[:, :RIM_PX] = False
    there = [i for i in range(len(HUES)) if hues[i, 0].sum() >= SMALLEST_PX]
    moving = robots.any(0) | hues[there].any((0, 1)) if there else robots.any(0)
    scenery = cv2.erode((~moving).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    area = robots.sum((1, 2)).astype(float)
    change = np.abs(every[1:].astype(np.int16) - every[0])
    drift = change[:, scenery].mean((1, 2)) if scenery.sum() > LEAST_SCENERY_PX else np.zeros(1)
    numbers = {
        "scenery": drift.max(), "start": change[0].mean(), "robot_least": -(area[1:] / (area[0] + 20)).min(),
    }
    new = (hues[i].sum((1, 2)) for i in range(len(HUES)) if i not in there)
    numbers["stranger"] = max((float(area[1:].max() - area[0]) for area in new), default=0.0)
    distances = [_distance(robot) for robot in robots]
    things = [_thing(hues[i], distances) for i in there]
    for name in things[0] if things else ():
        numbers[name] = max(thing[name] for thing in things)
    return numbers


def _distance(robot: BoolArray) -> NDArray[np.float32]:
    """Of each pixel to the nearest of the robot, px."""
    if not robot.any():
        return np.full(robot.shape, NO_ROBOT_PX, np.float32)
    return np.asarray(cv2.distanceTransform((~robot).astype(np.uint8), cv2.DIST_L2, 3), np.float32)


def _thing(masks: BoolArray, distances: Sequence[NDArray[np.float32]]) -> dict[str, float]:
    """Numbers of one coloured thing, (T + 1, H, W), that the reference shows. distances: of its pixels, _distance."""
    area, lengths = masks.sum((1, 2)).astype(float), np.array([_length(mask) for mask in masks])
    middles = [_middle(mask) for mask in masks]
    gap = _gaps(masks, middles, distances)
    nearer, free = np.minimum(gap[:-1], gap[1:]), (gap > TOUCH_PX + 2)[1:]
    alone = np.clip((nearer - TOUCH_PX) / (ALONE_PX - TOUCH_PX), 0, 1)
    moves, change = _moves(middles), np.diff(area) / max(area[0], SMALLEST_PX)
    return {
        "thing_moves_alone": float((alone * moves).sum()), "thing_far_of_robot": float((moves * nearer).max()),
        "thing_lost_alone": float((alone * -change).max()), "thing_gained_alone": float((alone * change).max()),
        "thing_shape": float((lengths[1:] / max(lengths[0], 1))[free].max(initial=1.0)),
    }


def _colours(every: UInt8Array, views: Sequence[slice], still: Sequence[bool]) -> dict[str, float]:
    """Numbers of the coloured things of the first still view by how much of their colour each view shows."""
    first = views[still.index(True)]
    chroma = every.astype(np.float32)
    chroma -= chroma.mean(-1, keepdims=True)
    own, start = every[:1, :, first], chroma[0, :, first]
    surface, found = np.median(start.reshape(-1, 3), 0), list[dict[str, float]]()
    for mask in (hue_masks(own) & _far(own, own[0]))[:, 0]:
        colour = np.median(start[mask], 0) - surface if mask.sum() >= SMALLEST_PX else np.zeros(3, np.float32)
        if np.linalg.norm(colour) < FAR:  # only lighter or darker than the surface
            continue
        shares = (chroma - surface) @ (colour / (colour @ colour))
        shares[shares < FAINT] = 0
        moving = [part for view, stays in zip(views, still) if not stays for part in shares[1:, :, view]]
        whole = max(float(shares[0, :, first].sum()), 1.0)
        seen = np.stack([
            shares[1:, :, view].sum((1, 2)) / (max(whole, float(shares[0, :, view].sum())) if stays else NEAR * whole)
            for view, stays in zip(views, still)
        ]).max(0)
        lengths = [_length(part > FULL) for part in moving]
        edges = [_edge(part) for part in moving if (part > FULL).sum() >= LEAST_SHAPE_PX]
        found.append({
            "thing_end": -float(seen[-2:].mean()), "thing_blurred": -float(np.median(edges or 1)),
            "thing_long": max(lengths, default=0.0) / max(_length(mask), 1),
        })
    return {name: max(thing[name] for thing in found) for name in found[0]} if found else {}


def _middle(mask: BoolArray) -> Floats | None:
    """Mean row and column, or None of fewer pixels than LEAST_MIDDLE_PX."""
    return np.asarray(np.argwhere(mask).mean(0)) if mask.sum() >= LEAST_MIDDLE_PX else None


def _moves(middles: Sequence[Floats | None]) -> Floats:
    """Distances between neighbours, px; 0 where one is not seen."""
    return np.array([0.0 if a is None or b is None else np.hypot(*(b - a)) for a, b in pairwise(middles)])


def _gaps(masks: BoolArray, middles: Sequence[Floats | None], distances: Sequence[NDArray[np.float32]]) -> Floats:
    """Distance between a thing and the robot in each picture (T + 1,), px; of its last place where it is not seen."""
    gaps, last = list[float](), middles[0]
    for mask, middle, distance in zip(masks, middles, distances):
        last = last if middle is None else middle
        place = np.argwhere(mask) if mask.any() or last is None else np.rint(last[None]).astype(int)
        gaps.append(float(distance[place[:, 0], place[:, 1]].min()))
    return np.array(gaps)


def _length(mask: BoolArray) -> float:
    """Standard deviation of its pixels along its long axis, px; 0 of fewer than LEAST_SHAPE_PX."""
    place = np.argwhere(mask)
    return float(np.sqrt(np.linalg.eigvalsh(np.cov(place.T))[-1] + 1 / 12)) if len(place) >= LEAST_SHAPE_PX else 0.0


def _edge(shares: Greys) -> float:
    """How fast a colour ends: mean of the steepest fifth around it, shares per px."""
    steps = np.zeros_like(shares)
    steps[:, :-1] = np.abs(np.diff(shares, axis=1))
    steps[:-1] = np.maximum(steps[:-1], np.abs(np.diff(shares, axis=0)))
    steepest = np.sort(steps[cv2.dilate((shares > FULL).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0])
    return float(steepest[-max(1, len(steepest) // 5) :].mean())
