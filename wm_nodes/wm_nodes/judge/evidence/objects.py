"""Evidence from masks: where the named object, the robot and the target are, and who moves whom (RA-17).

Shapes: T frames, H W image. Lengths are in object sizes (square root of its area in the reference frame), so that
distance to the camera does not matter. Every number is finite; where there is no object, distances are FAR.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.evidence.pictures import TURN
from wm_nodes.judge.evidence.segmentation import OBJECT, ROBOT
from wm_nodes.judge.evidence.tracks import SMALLEST_PX, Floats, Track, track

FAR = 20.0
"""Largest length, in object sizes."""
TOUCH = 0.3
"""A robot at most this far from the object, in object sizes, may touch it."""
MOVED = 0.12
"""An object that goes further in a step, in object sizes, moves; less is noise of the masks."""
SEEN = 0.2
"""An object of which this share of its reference area is visible is seen."""
RESHAPED_FRAMES = 3
HUES_DEGREES = {"red": 0.0, "orange": 32.0, "yellow": 55.0, "green": 130.0, "blue": 225.0, "purple": 288.0}
"""Angle of r + g exp(2 pi i / 3) + b exp(4 pi i / 3) of the colours that instructions name."""

Numbers = dict[str, float]


@dataclass(frozen=True)
class Target:
    """The disc that the instruction names, as an ellipse in the reference frame: distance 1 is its edge."""

    centre: Floats
    inverse: Floats

    def distance(self, points: Floats) -> Floats:
        """(...,) of points (..., 2)."""
        away = points - self.centre
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", away, self.inverse, away)))


@dataclass(frozen=True)
class Scene:
    """A clip's masks and what several kinds of evidence read off them; the reference frame comes first.

    masks: uint8 (1 + T, H, W) of the classes of segmentation.py. thing: the object's track. size: px, of the object in
    the reference frame. gap: (1 + T,) from object to robot, sizes. tool: (1 + T, 2) the robot's lowest part, px.
    """

    masks: UInt8Array
    thing: Track
    size: float
    gap: Floats
    tool: Floats


def scene_of(masks: UInt8Array) -> Scene:
    thing, arm = track(masks == OBJECT), masks == ROBOT
    size = float(np.sqrt(thing.area[0])) if thing.area[0] >= SMALLEST_PX else np.sqrt(masks[0].size) / 10
    gap = np.minimum(robot_gaps(arm, masks == OBJECT) / size, FAR)
    return Scene(masks, thing, size, gap, tool_points(arm))


def object_evidence(scene: Scene, reference: UInt8Array, instruction: str) -> Numbers:
    """Evidence of one clip.

    Args:
        reference: uint8 (H, W, 3). instruction: names the object's colour first, then the target's.
    """
    masks, thing, size, gap, tool = scene.masks, scene.thing, scene.size, scene.gap, scene.tool
    target = target_of(masks[0], reference, instruction)
    place, known = fill_gaps(thing.centre), np.isfinite(thing.area)
    return {
        **_shape(thing, gap, known), **_outline(thing, known), **_measure_reshaping(thing, place, gap, size),
        **_measure_cover(masks, thing), **_measure_touch(masks, thing, gap, size), **_movement(place, known, size),
        **_causes(place, known, gap, tool, size), **_task(place, tool, target, size, instruction),
    }


def tool_points(arm: NDArray[np.bool_]) -> Floats:
    """(T, 2) row and column of the robot's lowest part, the finger tips; NaN where no robot is."""
    points = np.full((len(arm), 2), np.nan)
    reached = arm.any(2)
    for t in np.flatnonzero(arm.sum((1, 2)) >= SMALLEST_PX):
        low = int(np.flatnonzero(reached[t])[-1])
        points[t] = low, np.nonzero(arm[t, max(0, low - 2) : low + 1])[1].mean()
    return points


def target_of(mask: UInt8Array, reference: UInt8Array, instruction: str) -> Target | None:
    """The disc of the second colour that the instruction names; None where it names none or it is not to be seen."""
    colours = [word for word in instruction.lower().replace(",", " ").split() if word in HUES_DEGREES]
    return find_target(reference, mask, colours[1]) if len(colours) > 1 else None


def find_target(reference: UInt8Array, mask: UInt8Array, colour: str) -> Target | None:
    """Fit an ellipse to the largest region of that colour outside of object and robot; None where there is none."""
    chroma = reference.astype(np.float32) @ TURN
    turn = np.exp(-1j * np.radians(HUES_DEGREES[colour])).astype(np.complex64)
    near = (np.abs(np.angle(chroma * turn)) < np.radians(20)) & (np.abs(chroma) > 60)
    near &= (mask != OBJECT) & (mask != ROBOT)
    closed = cv2.morphologyEx(near.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    number, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    if number < 2:
        return None
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    if stats[largest, cv2.CC_STAT_AREA] < 4 * SMALLEST_PX:
        return None
    hull = cv2.convexHull(cv2.findNonZero((labels == largest).astype(np.uint8)))
    hull_mask = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), hull, 1)
    points = np.argwhere(hull_mask).astype(np.float64)
    spread = np.cov(points.T) + 0.1 * np.eye(2)
    return Target(points.mean(0), np.linalg.inv(4 * spread))  # a disc's variance is r^2 / 4


def robot_gaps(arm: NDArray[np.bool_], thing: NDArray[np.bool_]) -> Floats:
    """(T,) px from the object to the robot; FAR where either is missing."""
    gaps = np.full(len(arm), np.inf)
    for t, (robot, mask) in enumerate(zip(arm, thing)):
        if robot.any() and mask.any():
            away = cv2.distanceTransform((~robot).view(np.uint8), cv2.DIST_L2, 3)
            gaps[t] = max(0.0, float(away[mask].min()) - 1)
    return gaps


def fill_gaps(points: Floats) -> Floats:
    """The last known place stands for a missing one; the first known one before it; zeros where none is known."""
    known = np.flatnonzero(np.isfinite(points[:, 0]))
    if not len(known):
        return np.zeros_like(points)
    last = np.maximum.accumulate(np.where(np.isfinite(points[:, 0]), np.arange(len(points)), known[0]))
    return np.asarray(points[np.maximum(last, known[0])])


def _shape(thing: Track, gap: Floats, known: NDArray[np.bool_]) -> Numbers:
    """Size and outline against the reference frame; `free` are frames in which the robot covers nothing of it."""
    area0 = thing.area[0] if known[0] else SMALLEST_PX
    height0, width0 = thing.box[0, 2:] if known[0] else (1.0, 1.0)
    area = np.where(known, thing.area, 0.0)[1:] / area0
    free = known[1:] & (gap[1:] > TOUCH)
    chosen = free if free.any() else known[1:] if known[1:].any() else np.ones(len(area), bool)
    high, wide = (np.nan_to_num(thing.box[1:, 2:]) / (height0, width0))[chosen].T
    second = thing.second[1:] / area0
    step = np.abs(np.diff(area[chosen])) if chosen.sum() > 1 else np.zeros(1)
    return {
        "object_seen": float((area > SEEN).mean()), "object_seen_last": float(area[-3:].mean()),
        "object_area_first": float(area[0]), "object_area_free": float(np.median(area[chosen])),
        "object_area_max": float(area.max()), "object_area_low": float(area[chosen].min()),
        "object_area_last": float(area[chosen][-1]), "object_area_step": float(step.max()),
        "object_height_max": float(high.max()), "object_height_min": float(high.min()),
        "object_height_last": float(high[-1]), "object_width_max": float(wide.max()),
        "object_width_min": float(wide.min()), "object_width_last": float(wide[-1]),
        "object_aspect": float((high / (wide + 1e-3)).mean()),
        "object_second": float((second > 0.25).mean()), "object_second_max": float(second.max()),
        "object_second_last": float(second[-3:].mean()),
    }


def _outline(thing: Track, known: NDArray[np.bool_]) -> Numbers:
    """Size and outline in all frames that show the object, a robot before it or not, against the reference frame."""
    if not known[0] or not known[1:].any():
        return dict.fromkeys(("tall_max", "tall_end", "wide_max", "wide_end", "long_max", "long_end", "thin_end"), 1.0)
    high, wide = (thing.box[1:, 2:][known[1:]] / thing.box[0, 2:]).T
    long, thin = (thing.axes[1:][known[1:]] / thing.axes[0]).T
    return {
        "tall_max": float(high.max()), "tall_end": float(high[-3:].mean()), "wide_max": float(wide.max()),
        "wide_end": float(wide[-3:].mean()), "long_max": float((long / thin).max()),
        "long_end": float((long / thin)[-3:].mean()), "thin_end": float(thin[-3:].mean()),
    }


def _measure_reshaping(thing: Track, place: Floats, gap: Floats, size: float) -> Numbers:
    """Change of the outline while nothing covers the object and it stays where it is: a rigid thing has none."""
    lag = min(RESHAPED_FRAMES, len(place) - 1)
    free = (gap > TOUCH) & np.isfinite(thing.area)
    away = np.linalg.norm(place[lag:] - place[:-lag], axis=1) / size
    chosen = free[lag:] & free[:-lag] & (away < 0.35)
    high, wide = (np.abs(np.log(thing.box[lag:, i] / thing.box[:-lag, i]))[chosen] for i in (2, 3))
    area = np.abs(np.log(thing.area[lag:] / thing.area[:-lag]))[chosen]
    return {
        name: float(values.max()) if len(values) else 0.0
        for name, values in (("reshaped_height", high), ("reshaped_width", wide), ("reshaped_area", area))
    }


def _measure_touch(masks: UInt8Array, thing: Track, gap: Floats, size: float) -> Numbers:
    """How much of the object is left to see, and how much robot is where it is, while the robot touches it."""
    area0 = thing.area[0] if np.isfinite(thing.area[0]) else SMALLEST_PX
    seen, inside = [], []
    for t in np.flatnonzero((gap <= TOUCH) & np.isfinite(thing.area)):
        top, left, height, width = (int(value) for value in thing.box[t])
        seen.append(float(thing.area[t]) / area0)
        inside.append(float((masks[t, top : top + height, left : left + width] == ROBOT).mean()))
    return {
        "touch_area": float(np.mean(seen)) if seen else 1.0, "touch_area_min": min(seen, default=1.0),
        "touch_inside": float(np.mean(inside)) if inside else 0.0, "touch_inside_max": max(inside, default=0.0),
    }


def _measure_cover(masks: UInt8Array, thing: Track) -> Numbers:
    """Whether a missing object is hidden by the robot, and how much of its first place the robot goes over."""
    there = masks[0] == OBJECT
    over = (masks[1:] == ROBOT)[:, there].mean(1) if there.any() else np.zeros(len(masks) - 1)
    left = (masks[1:] == OBJECT)[:, there].mean(1) if there.any() else np.zeros(len(masks) - 1)
    lost = ~np.isfinite(thing.area[1:])
    reach = np.zeros(len(lost))
    for t in np.flatnonzero(lost):  # the robot around the place where the object was last
        place = fill_gaps(thing.centre)[t]
        row, column = (int(np.clip(value, 0, size - 1)) for value, size in zip(place, masks.shape[1:]))
        side = int(np.ceil(np.sqrt(thing.area[0] if np.isfinite(thing.area[0]) else SMALLEST_PX))) + 1
        window = masks[t + 1, max(0, row - side) : row + side + 1, max(0, column - side) : column + side + 1]
        reach[t] = float((window == ROBOT).mean())
    return {
        "object_lost": float(lost.mean()), "object_lost_open": float((lost & (reach < 0.2)).mean()),
        "place_covered_max": float(over.max()),
        "place_held_last": float(left[-1]), "place_empty_last": float(1 - left[-1] - over[-1]),
    }


def _movement(place: Floats, known: NDArray[np.bool_], size: float) -> Numbers:
    """How far the object goes, and how evenly. place: (1 + T, 2)."""
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1) / size
    steps = np.where(known[1:] & known[:-1], steps, 0.0)
    away = np.linalg.norm(place - place[0], axis=1) / size
    moves = steps > MOVED
    seen = np.flatnonzero(known)
    hidden = np.flatnonzero(np.diff(seen) > 1)
    again = [np.linalg.norm(place[seen[i + 1]] - place[seen[i]]) / size for i in hidden]
    low = (place[1:, 0] - place[0, 0]) / size
    lag = min(RESHAPED_FRAMES, len(place) - 1)
    rises = (place[:-lag, 0] - place[lag:, 0]) / size
    return {
        "object_path": min(FAR, float(steps.sum())), "object_net": min(FAR, float(away[-1])),
        "object_step": min(FAR, float(steps.max())),
        "object_steps_moving": float(moves.mean()),
        "object_step_share": float(steps.max() / (steps.sum() + 0.1)), "object_first_away": min(FAR, float(away[1])),
        "object_raised": float(np.clip(-low.min(), 0, FAR)),
        "object_rise": float(np.clip(rises.max(), 0, FAR)),
        "object_rise_late": float(np.clip(rises[len(rises) // 2 :].max(), 0, FAR)),
        "object_reappeared": min(FAR, float(max(again, default=0.0))),
    }


def _causes(place: Floats, known: NDArray[np.bool_], gap: Floats, tool: Floats, size: float) -> Numbers:
    """Contact and its effect: motion without a robot near, a robot that passes without effect, rising after release."""
    steps = np.diff(place, axis=0) / size
    length = np.where(known[1:] & known[:-1], np.linalg.norm(steps, axis=1), 0.0)
    moving = np.flatnonzero(length > MOVED)
    nearest = np.minimum(gap[1:], gap[:-1])
    apart = length * (nearest > TOUCH)
    touched = gap <= TOUCH
    first_touch = int(np.flatnonzero(touched)[0]) if touched.any() else len(gap)
    onset = int(moving[0]) if len(moving) else len(gap)
    last_touch = int(np.flatnonzero(touched)[-1]) if touched.any() else 0
    after = (place[-1] - place[last_touch]) / size
    loose = place[last_touch:, 0] if last_touch < len(place) - 1 else place[-1:, 0]
    hand = fill_gaps(tool)
    sweep = np.diff(hand, axis=0) / size
    way = hand[-1] - hand[0]
    course = way / (np.linalg.norm(way) + 1e-6)
    beside = (hand - place) @ course / size
    slip = np.where(touched[1:] & touched[:-1], np.linalg.norm(sweep, axis=1) - length, 0.0)
    relative = np.linalg.norm(hand - place, axis=1) / size
    return {
        "gap_min": float(gap.min()), "gap_last": float(gap[-1]),
        "gap_onset": float(nearest[onset]) if len(moving) else 0.0,
        "gap_moving_max": float(nearest[moving].max()) if len(moving) else 0.0,
        "gap_moving_mean": float(nearest[moving].mean()) if len(moving) else 0.0,
        "moved_apart": min(FAR, float(apart.sum())), "moved_apart_step": min(FAR, float(apart.max())),
        "touched_share": float(touched.mean()), "touch_first": first_touch / len(gap), "onset": onset / len(gap),
        "touch_after_onset": float(np.clip((first_touch - onset) / len(gap), -1, 1)),
        "after_touch_side": min(FAR, float(abs(after[1]))),
        "after_touch_rise": float(np.clip((loose[0] - loose.min()) / size, 0, FAR)),
        "tool_path": min(FAR, float(np.linalg.norm(sweep, axis=1).sum())),
        "tool_net": min(FAR, float(np.linalg.norm(way) / size)), "tool_passed": float(np.clip(beside.max(), -FAR, FAR)),
        "slipped": float(np.clip(slip.sum(), -FAR, FAR)), "tool_near_min": min(FAR, float(relative.min())),
    }


def _task(place: Floats, tool: Floats, target: Target | None, size: float, instruction: str) -> Numbers:
    """How far the clip gets: the object towards the target, the tool towards a place above the object."""
    distance = np.full(len(place), FAR) if target is None else np.minimum(target.distance(place), FAR)
    relative = np.clip((fill_gaps(tool) - place) / size, -FAR, FAR)
    length = np.linalg.norm(relative, axis=1)
    start, end = float(distance[0]), float(distance[-1])
    return {
        "asks_above": float(" above " in f" {instruction} "),
        "target_start": start, "target_end": end, "target_min": float(distance.min()),
        "target_progress": float(np.clip((start - end) / max(start - 1, 0.1), -2, 2)) if target is not None else 0.0,
        "tool_above_end": float(-relative[-1, 0]), "tool_beside_end": float(abs(relative[-1, 1])),
        "tool_near_end": min(FAR, float(length[-1])), "tool_nearer": float(np.clip(length[0] - length[-1], -FAR, FAR)),
    }
