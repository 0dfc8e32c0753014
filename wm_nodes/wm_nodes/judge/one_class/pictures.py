"""Numbers of a clip's pictures: what is seen, what appears, vanishes or moves by itself (RA-27).

Nothing is known of the scene: a view's commonest colour is taken for its surface, what is far from it for things, each
saturated hue for one thing, and what is far and grey for the robot. Larger always means stranger.
Shapes: T frames, H W 3 image, N coloured things.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, UInt8Array

Floats = NDArray[np.float64]

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

COMPONENTS: Mapping[str, str] = {
    "blurred": "clarity", "noise": "clarity", "noise_change": "clarity",
    "light": "brightness", "light_change": "brightness", "tint": "color", "thing_tone": "color",
    "flicker": "temporal", "frozen": "temporal", "jump": "temporal", "turns_back": "temporal", "views_disagree": "temporal", "one_view_still": "temporal", 
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
    angle = 60 * np.where(top == x[..., 0], ((g - b) / wide) % 6, np.where(top == x[..., 1], (b - r) / wide + 2, (r - g) / wide + 4))
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
    x = frames.astype(np.float32)
    every = np.concatenate([reference[None], frames]).astype(np.float32)
    grey = every.mean(-1)
    d = _steps(frames)
    laplace = np.abs(4 * grey[:, 1:-1, 1:-1] - grey[:, :-2, 1:-1] - grey[:, 2:, 1:-1] - grey[:, 1:-1, :-2] - grey[:, 1:-1, 2:])
    edges = np.sort(laplace.reshape(len(grey), -1), 1)[:, -laplace[0].size // 20 :].mean(1)  # of the sharpest 5 %
    noise = np.median(laplace.reshape(len(grey), -1), 1)
    light = grey.mean((1, 2))
    tint = every.mean((1, 2)) / (light[:, None] + 1)
    twice = np.abs(np.diff(light, 2)) if len(light) > 3 else np.zeros(1)
    back = [np.abs(x[t] - x[t - 2]).mean() / (d[t - 1] + 0.3) for t in range(2, len(x))]
    numbers = {
        "blurred": -(edges[1:] / (edges[0] + 1)).min() if still else -edges[1:].min() / (edges[1:].mean() + 1),
        "noise": noise[1:].max(), "noise_change": np.abs(np.diff(noise[1:])).max(),
        "light_change": np.abs(np.diff(light[1:])).max(),
        "flicker": twice[1:].max() if len(twice) > 1 else 0.0,
        "frozen": -np.median(d), "jump": d.max() / (np.median(d) + 0.5), "turns_back": -min(back, default=1.0),
    }
    if not still:
        return {name: float(value) for name, value in numbers.items()}
    numbers |= {"light": np.abs(light[1:] - light[0]).max(), "tint": np.abs(tint[1:] - tint[0]).max()}
    numbers |= _still_view(frames, reference, grey)
    return {name: float(value) for name, value in numbers.items()}


def _still_view(frames: UInt8Array, reference: UInt8Array, grey: NDArray[np.float32]) -> dict[str, float]:
    """Numbers that need a camera that stands still. grey: (T + 1, H, W), of the reference, then the frames."""
    T = len(frames)
    every = np.concatenate([reference[None], frames])
    far = _far(every, reference)
    hues = hue_masks(every) & far
    span = every.max(-1).astype(np.int16) - every.min(-1)
    robots = far & (span < GREY) & ~hues.any(0)
    robots[:, :2] = False
    there = [i for i in range(len(HUES)) if hues[i, 0].sum() >= SMALLEST_PX]
    new = [i for i in range(len(HUES)) if i not in there]
    numbers = _robot(robots, every)
    moving = robots.any(0) | hues[there].any((0, 1)) if there else robots.any(0)
    scenery = cv2.erode((~moving).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    drift = np.abs(every[1:].astype(np.int16) - reference)[:, scenery]
    drift = drift.mean((1, 2)) if scenery.sum() > 50 else np.zeros(T)
    shifts = np.array([_shift(grey[0], grey[t], scenery) for t in range(1, T + 1)])
    numbers |= {
        "scenery": drift.max(), "scenery_change": np.abs(np.diff(drift)).max(),
        "stranger": max((float(hues[i, 1:].sum((1, 2)).max() - hues[i, 0].sum()) for i in new), default=0.0),
        "start": np.abs(every[1].astype(np.int16) - reference).mean(),
        "shifted": shifts.max(),
    }
    distances = [cv2.distanceTransform((~robot).astype(np.uint8), cv2.DIST_L2, 3) if robot.any() else np.full(robot.shape, 64.0) for robot in robots]
    things = [_thing(hues[i], distances, every) for i in there]
    for name in things[0] if things else ():
        numbers[name] = max(thing[name] for thing in things)
    return numbers


def _robot(robots: BoolArray, every: UInt8Array) -> dict[str, float]:
    area = robots.sum((1, 2)).astype(float)
    usual = np.median(area) + 20
    middles = [np.argwhere(r).mean(0) if r.sum() >= 8 else None for r in robots]
    steps = [np.hypot(*(b - a)) for a, b in zip(middles[1:], middles[2:]) if a is not None and b is not None]
    apart = []
    for robot in robots[1:]:
        _, _, stats, _ = cv2.connectedComponentsWithStats(robot.astype(np.uint8), connectivity=8)
        apart.append(stats[1:, 4].sum() - stats[1:, 4].max(initial=0))
    tone = np.array([np.median(every[t][robots[t]], 0) if robots[t].sum() >= 8 else [np.nan] * 3 for t in range(len(robots))])
    change = np.abs(tone[1:] - tone[0])
    return {
        "robot_least": -(area[1:] / (area[0] + 20)).min(), "robot_loss": max(area[:-1] - area[1:]) / usual, "robot_gain": max(area[1:] - area[:-1]) / usual,
        "robot_apart": float(max(apart)), "robot_jump": max(steps, default=0.0),
        "robot_tone": float(np.nanmax(change)) if np.isfinite(change).any() else 0.0,
    }


def _thing(masks: BoolArray, distances: list[NDArray[np.float32]], every: UInt8Array) -> dict[str, float]:
    """Numbers of one coloured thing, (T + 1, H, W)."""
    area = masks.sum((1, 2)).astype(float)
    base = max(area[0], SMALLEST_PX)
    middles: list[Floats | None] = [np.argwhere(m).mean(0) if m.sum() >= 4 else None for m in masks]
    gaps, last = [], middles[0]
    for t, mask in enumerate(masks):
        last = middles[t] if middles[t] is not None else last
        place = np.argwhere(mask) if mask.any() else np.rint(last[None]).astype(int)
        gaps.append(float(distances[t][place[:, 0], place[:, 1]].min()))
    gap = np.array(gaps)
    alone = np.clip((np.minimum(gap[:-1], gap[1:]) - TOUCH_PX) / (ALONE_PX - TOUCH_PX), 0, 1)
    moves = np.array([np.hypot(*(b - a)) if a is not None and b is not None else 0.0 for a, b in zip(middles, middles[1:])])
    change = np.diff(area) / base
    seconds = []
    spread = []
    for mask in masks:
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
        seconds.append(float(np.sort(stats[1:, 4])[-2]) if len(stats) > 2 else 0.0)
        place = np.argwhere(mask)
        spread.append(place.std(0).sum() / np.sqrt(len(place)) if len(place) >= 6 else np.nan)
    free = gap > TOUCH_PX + 2
    tone = np.array([np.median(every[t][masks[t]], 0) if area[t] >= 6 else [np.nan] * 3 for t in range(len(masks))])
    tones = np.abs(tone[1:] - tone[0])
    shape = np.abs(np.array(spread[1:]) - spread[0])[free[1:]]
    return {
        "thing_tone": float(np.nanmax(tones)) if np.isfinite(tones).any() else 0.0,
        "thing_moves_alone": float((alone * moves).sum()), "thing_jump": float(moves.max()),
        "thing_far_of_robot": float((moves * np.minimum(gap[:-1], gap[1:])).max()),
        "thing_lost": float((-change).max()), "thing_lost_alone": float((alone * -change).max()),
        "thing_gained_alone": float((alone * change).max()), "thing_missing_end": -float(area[-2:].mean() / base),
        "thing_grown": float((area[1:] / base).max()),
        "thing_shrunk": -float((area[1:] / base)[free[1:]].min(initial=1.0)), "thing_twice": max(seconds[1:]),
        "thing_shape": float(np.nanmax(shape)) if np.isfinite(shape).any() else 0.0,
    }


def _shift(first: NDArray[np.float32], other: NDArray[np.float32], scenery: BoolArray) -> float:
    """How far the scenery of two pictures is shifted, px."""
    if scenery.sum() < 50:
        return 0.0
    blend = [np.where(scenery, picture, np.float32(np.median(first))) for picture in (first, other)]
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(*(np.ascontiguousarray(p, np.float32) for p in blend), window)
    return float(np.hypot(dx, dy)) if response > 0.05 else 0.0
