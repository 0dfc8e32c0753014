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
"""Pixels of the scenery that its numbers need; they are 0 of fewer."""

COMPONENTS: Mapping[str, str] = {
    "blurred": "clarity", "noise": "clarity", "noise_change": "clarity",
    "light": "brightness", "light_change": "brightness", "tint": "color", "thing_tone": "color",
    "flicker": "temporal", "frozen": "temporal", "jump": "temporal", "turns_back": "temporal",
    "views_disagree": "temporal", "one_view_still": "temporal",
    "scenery": "background", "scenery_change": "background", "stranger": "background",
    "start": "objective", "thing_lost": "objective", "thing_lost_alone": "objective", "thing_missing_end": "objective",
    "robot_least": "robot", "robot_loss": "robot", "robot_gain": "robot", "robot_apart": "robot",
    "robot_tone": "robot", "robot_jump": "robot", "shifted": "viewpoint",
    "thing_moves_alone": "interaction", "thing_jump": "interaction", "thing_far_of_robot": "interaction",
    "thing_grown": "deformation", "thing_twice": "deformation", "thing_gained_alone": "deformation",
    "thing_shape": "deformation", "thing_shrunk": "deformation",
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
    steps = np.stack([_steps(frames[:, :, view]) for view in views])
    numbers["views_disagree"] = numbers["one_view_still"] = 0.0
    if len(views) > 1:
        ratio = np.log((steps[0] + 0.3) / (steps[1:].mean(0) + 0.3))
        numbers["views_disagree"] = float(np.abs(ratio - np.median(ratio)).max())
        numbers["one_view_still"] = float((steps.max(0) * (steps.min(0) < 0.05)).max())
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


def _steps(frames: UInt8Array) -> Floats:
    """Mean absolute change (T - 1,), grey levels."""
    return np.asarray(np.abs(np.diff(frames.astype(np.int16), axis=0)).mean((1, 2, 3)), np.float64)


def _view(frames: UInt8Array, reference: UInt8Array, still: bool) -> dict[str, float]:
    """Numbers of one view."""
    every = np.concatenate([reference[None], frames])
    grey = every.astype(np.float32).mean(-1)
    numbers = _sharpness(grey, still) | _light(grey, every, still) | _changes(frames)
    if still:
        numbers |= _still_view(every, grey)
    return {name: float(value) for name, value in numbers.items()}


def _sharpness(grey: Greys, still: bool) -> dict[str, float]:
    """Numbers of a view's detail. grey: (T + 1, H, W), of the reference, then the frames; likewise below."""
    rows, columns = grey[:, :, 1:-1], grey[:, 1:-1]
    laplace = 4 * columns[:, :, 1:-1] - rows[:, :-2] - rows[:, 2:] - columns[:, :, :-2] - columns[:, :, 2:]
    laplace = np.abs(laplace).reshape(len(grey), -1)
    edges = np.sort(laplace, 1)[:, -laplace[0].size // 20 :].mean(1)  # of the sharpest 5 %
    noise = np.median(laplace, 1)
    return {
        "blurred": -(edges[1:] / (edges[0] + 1)).min() if still else -edges[1:].min() / (edges[1:].mean() + 1),
        "noise": noise[1:].max(), "noise_change": np.abs(np.diff(noise[1:])).max(),
    }


def _light(grey: Greys, every: UInt8Array, still: bool) -> dict[str, float]:
    """Numbers of a view's mean level and, where its camera stands still, of its distance to the reference's."""
    light = grey.mean((1, 2))
    twice = np.abs(np.diff(light, 2)) if len(light) > 3 else np.zeros(1)
    numbers = {
        "light_change": np.abs(np.diff(light[1:])).max(), "flicker": twice[1:].max() if len(twice) > 1 else 0.0,
    }
    if not still:
        return numbers
    tint = every.astype(np.float32).mean((1, 2)) / (light[:, None] + 1)
    return numbers | {"light": np.abs(light[1:] - light[0]).max(), "tint": np.abs(tint[1:] - tint[0]).max()}


def _changes(frames: UInt8Array) -> dict[str, float]:
    """Numbers of how far a view changes from frame to frame."""
    x, d = frames.astype(np.float32), _steps(frames)
    back = [np.abs(x[t] - x[t - 2]).mean() / (d[t - 1] + 0.3) for t in range(2, len(x))]
    return {"frozen": -np.median(d), "jump": d.max() / (np.median(d) + 0.5), "turns_back": -min(back, default=1.0)}


def _still_view(every: UInt8Array, grey: Greys) -> dict[str, float]:
    """Numbers that need a camera that stands still. every: (T + 1, H, W, 3), the reference, then the frames."""
    far = _far(every, every[0])
    hues = hue_masks(every) & far
    span = every.max(-1).astype(np.int16) - every.min(-1)
    robots = far & (span < GREY) & ~hues.any(0)
    robots[:, :RIM_PX] = False
    there = [i for i in range(len(HUES)) if hues[i, 0].sum() >= SMALLEST_PX]
    moving = robots.any(0) | hues[there].any((0, 1)) if there else robots.any(0)
    scenery = cv2.erode((~moving).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    numbers = _robot(robots, every) | _scenery(every, grey, scenery)
    new = (hues[i].sum((1, 2)) for i in range(len(HUES)) if i not in there)
    numbers["stranger"] = max((float(area[1:].max() - area[0]) for area in new), default=0.0)
    distances = [_distance(robot) for robot in robots]
    things = [_thing(hues[i], distances, every) for i in there]
    for name in things[0] if things else ():
        numbers[name] = max(thing[name] for thing in things)
    return numbers


def _scenery(every: UInt8Array, grey: Greys, scenery: BoolArray) -> dict[str, float]:
    """Numbers of what should not change. scenery: (H, W), the pixels where there is never a robot or a thing."""
    change = np.abs(every[1:].astype(np.int16) - every[0])
    drift = change[:, scenery].mean((1, 2)) if scenery.sum() > LEAST_SCENERY_PX else np.zeros(len(change))
    return {
        "scenery": drift.max(), "scenery_change": np.abs(np.diff(drift)).max(), "start": change[0].mean(),
        "shifted": max(_shift(grey[0], other, scenery) for other in grey[1:]),
    }


def _distance(robot: BoolArray) -> NDArray[np.float32]:
    """Of each pixel to the nearest of the robot, px."""
    if not robot.any():
        return np.full(robot.shape, NO_ROBOT_PX, np.float32)
    return np.asarray(cv2.distanceTransform((~robot).astype(np.uint8), cv2.DIST_L2, 3), np.float32)


def _robot(robots: BoolArray, every: UInt8Array) -> dict[str, float]:
    """Numbers of the robot, (T + 1, H, W)."""
    area = robots.sum((1, 2)).astype(float)
    usual = np.median(area) + 20
    middles = [_middle(robot, 8) for robot in robots[1:]]
    apart = [sum(parts) - max(parts, default=0.0) for parts in map(_parts, robots[1:])]
    return {
        "robot_least": -(area[1:] / (area[0] + 20)).min(), "robot_loss": max(area[:-1] - area[1:]) / usual,
        "robot_gain": max(area[1:] - area[:-1]) / usual, "robot_apart": max(apart),
        "robot_jump": float(_moves(middles).max()), "robot_tone": _largest_change(_tones(robots, every, 8)),
    }


def _thing(masks: BoolArray, distances: Sequence[NDArray[np.float32]], every: UInt8Array) -> dict[str, float]:
    """Numbers of one coloured thing, (T + 1, H, W), that the reference shows. distances: of its pixels, _distance."""
    area = masks.sum((1, 2)).astype(float)
    base = max(area[0], SMALLEST_PX)
    middles = [_middle(mask, 4) for mask in masks]
    gap = _gaps(masks, middles, distances)
    nearer, free = np.minimum(gap[:-1], gap[1:]), (gap > TOUCH_PX + 2)[1:]
    alone = np.clip((nearer - TOUCH_PX) / (ALONE_PX - TOUCH_PX), 0, 1)
    moves, change = _moves(middles), np.diff(area) / base
    seconds = [sorted(parts)[-2] if len(parts) > 1 else 0.0 for parts in map(_parts, masks[1:])]
    return {
        "thing_tone": _largest_change(_tones(masks, every, 6)),
        "thing_moves_alone": float((alone * moves).sum()), "thing_jump": float(moves.max()),
        "thing_far_of_robot": float((moves * nearer).max()),
        "thing_lost": float((-change).max()), "thing_lost_alone": float((alone * -change).max()),
        "thing_gained_alone": float((alone * change).max()), "thing_missing_end": -float(area[-2:].mean() / base),
        "thing_grown": float((area[1:] / base).max()),
        "thing_shrunk": -float((area[1:] / base)[free].min(initial=1.0)), "thing_twice": max(seconds),
        "thing_shape": _largest_change(np.array([_spread(mask) for mask in masks]), free),
    }


def _middle(mask: BoolArray, least_px: int) -> Floats | None:
    """Mean row and column, or None of fewer pixels."""
    return np.asarray(np.argwhere(mask).mean(0)) if mask.sum() >= least_px else None


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


def _parts(mask: BoolArray) -> list[float]:
    """Areas of the connected parts, px."""
    areas: list[float] = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)[2][1:, 4].tolist()
    return areas


def _tones(masks: BoolArray, every: UInt8Array, least_px: int) -> Floats:
    """Median colour in each picture (T + 1, 3), grey levels; NaN of fewer pixels."""
    unseen = np.full(3, np.nan)
    return np.stack([np.median(x[m], 0) if m.sum() >= least_px else unseen for x, m in zip(every, masks)])


def _spread(mask: BoolArray) -> float:
    """How far its pixels lie apart, for their number; NaN of fewer than six."""
    place = np.argwhere(mask)
    return float(place.std(0).sum() / np.sqrt(len(place))) if len(place) >= 6 else np.nan


def _largest_change(values: Floats, where: BoolArray | None = None) -> float:
    """From the first to any later value, where both are known; 0 where there are none."""
    change = np.abs(values[1:] - values[0])
    known = change[np.isfinite(change)] if where is None else change[where & np.isfinite(change)]
    return float(known.max(initial=0.0))


def _shift(first: Greys, other: Greys, scenery: BoolArray) -> float:
    """How far the scenery of two pictures is shifted, px."""
    if scenery.sum() < LEAST_SCENERY_PX:
        return 0.0
    fill = np.float32(np.median(first))
    blend = [np.where(scenery, picture, fill).astype(np.float32) for picture in (first, other)]
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(blend[0], blend[1], window)
    return float(np.hypot(dx, dy)) if response > 0.05 else 0.0
