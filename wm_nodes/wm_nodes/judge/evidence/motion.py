"""Evidence of motion without a cause and of outlines to parts of a pixel: jumps, attraction, tools that go through.

See RA-17. What objects.py says of masks is too coarse for an object of ten pixels beside a gripper: here a pixel at
its edge counts by how much of the object's colour it has, and every step is held against the tool's own.
Shapes: T frames with the reference frame before them, H W image. Lengths are in object sizes, as in objects.py.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, UInt8Array
from wm_nodes.judge.evidence.objects import FAR, TOUCH, Numbers, Scene, fill_gaps
from wm_nodes.judge.evidence.pictures import TURN
from wm_nodes.judge.evidence.quantiles import median, quantile
from wm_nodes.judge.evidence.segmentation import OBJECT, ROBOT
from wm_nodes.judge.evidence.tracks import SMALLEST_PX, Floats

AROUND_PX = 3
"""So far around the object's box its colour is looked for."""
GREY = 15.0
"""An object of less chroma than this, levels, has no colour to weigh by: its mask is taken as it is."""
REST, STILL, COURSE = 0.15, 0.12, 0.1
"""A step of the object below this is rest; of the tool, stillness; above this the tool has a direction. Sizes."""
NEAR, PLACE = 0.6, 0.35
"""A tool point this near goes through the object; an object this near to a place is there. Sizes."""
CLEAR = 0.15
"""A robot further away covers nothing of the outline, sizes."""
AROUND = np.ones((3, 3), np.uint8)
"""A pixel and its neighbours."""
SHAPES = ("tall", "wide", "area", "long")


@dataclass(frozen=True)
class Outline:
    """The object's pixels, weighted by its colour; NaN where it is not seen.

    area: (T,) px. centre: (T, 2) row and column. spread: (T, 2) standard deviation of rows and of columns. axes: (T, 2)
    longer and shorter one. ring: (T,) share of the pixels around it that are robot. hollow: (T,) share of its convex
    hull that is something else. Both are 0 where it is not seen.
    """

    area: Floats
    centre: Floats
    spread: Floats
    axes: Floats
    ring: Floats
    hollow: Floats


def motion_evidence(scene: Scene, outline: Outline) -> Numbers:
    """Evidence of one clip."""
    size, gap = scene.size, scene.gap
    known = np.isfinite(outline.area)
    place, hand = fill_gaps(outline.centre) / size, fill_gaps(scene.tool) / size
    evidence = {
        **_jumps(outline, place, hand, gap, known), **_passing(place, hand), **_contact(outline, gap),
        **_shapes(outline, place, gap, known),
    }
    values = np.clip(np.nan_to_num(np.array(list(evidence.values()), np.float64)), -FAR, FAR)
    return dict(zip(evidence, values.tolist()))


def outline_of(scene: Scene, pictures: UInt8Array) -> Outline:
    """Follow the object's coloured pixels in and around its mask.

    Args:
        pictures: uint8 (1 + T, H, W, 3), the reference frame first.
    """
    masks, thing = scene.masks, scene.thing
    count, height, width = masks.shape
    numbers = np.full((count, 7), np.nan)
    ring, hollow = np.zeros(count), np.zeros(count)
    for t in np.flatnonzero(np.isfinite(thing.area)):
        top, left, high, wide = (int(value) for value in thing.box[t])
        rows = slice(max(0, top - AROUND_PX), min(height, top + high + AROUND_PX))
        columns = slice(max(0, left - AROUND_PX), min(width, left + wide + AROUND_PX))
        shown = masks[t, rows, columns]
        mask = shown == OBJECT
        solid = mask.view(np.uint8)
        weights = _colour_weights(pictures[t, rows, columns], mask)
        area = float(weights.sum())
        if area < SMALLEST_PX / 2:
            continue
        y, x = np.arange(rows.start, rows.stop)[:, None], np.arange(columns.start, columns.stop)
        row, column = (weights * y).sum() / area, (weights * x).sum() / area
        down, right = ((weights * away**2).sum() / area + 1 / 12 for away in (y - row, x - column))
        mixed = (weights * (y - row) * (x - column)).sum() / area
        middle, half = (down + right) / 2, np.hypot((down - right) / 2, mixed)
        axes = [math.sqrt(max(value, 1 / 12)) for value in (middle + half, middle - half)]
        numbers[t] = (area, row, column, math.sqrt(down), math.sqrt(right), *axes)
        edge = cv2.dilate(solid, AROUND) != solid
        ring[t] = np.count_nonzero(edge & (shown == ROBOT)) / max(np.count_nonzero(edge), 1)
        hull = cv2.convexHull(cv2.findNonZero(solid))
        filled_hull = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), hull, 1)
        hollow[t] = 1 - np.count_nonzero(mask) / np.count_nonzero(filled_hull)
    return Outline(numbers[:, 0], numbers[:, 1:3], numbers[:, 3:5], numbers[:, 5:], ring, hollow)


def _colour_weights(picture: UInt8Array, mask: BoolArray) -> NDArray[np.float32]:
    """(H, W) in [0, 1], how much of the object's colour a pixel in or around its mask has."""
    chroma = picture.astype(np.float32) @ TURN
    mean = chroma[mask].mean()
    if abs(mean) < GREY:
        return mask.astype(np.float32)
    turned = chroma * np.conj(mean / abs(mean))
    along, across = turned.real, np.abs(turned.imag)
    weights = np.minimum(np.maximum((along / max(float(median(along[mask])), 1.0) - 0.2) / 0.6, 0), 1)
    near = cv2.dilate(mask.view(np.uint8), AROUND, iterations=2) > 0
    return np.asarray(np.where(near & (across < 0.5 * np.maximum(along, 1)), weights, 0), np.float32)


def _jumps(outline: Outline, place: Floats, hand: Floats, gap: Floats, known: BoolArray) -> Numbers:
    """Steps of the object that the tool's do not explain. place, hand: (1 + T, 2), sizes."""
    steps, sweeps = np.diff(place, axis=0), np.diff(hand, axis=0)
    steps = np.where((known[1:] & known[:-1])[:, None], steps, 0.0)
    length, pace = np.linalg.norm(steps, axis=1), np.linalg.norm(sweeps, axis=1)
    near = np.minimum(gap[1:], gap[:-1])
    apart = (hand - place)[:-1]
    pulled = (steps * apart).sum(1) / np.maximum(np.linalg.norm(apart, axis=1), 1e-3)
    closing = (sweeps * -apart).sum(1) / np.maximum(np.linalg.norm(apart, axis=1), 1e-3)
    hit = np.maximum(np.maximum(closing, np.append(0.0, closing[:-1])), 0)
    course = sweeps / np.maximum(pace, 1e-3)[:, None]
    along, side = (steps * course).sum(1), np.abs(steps[:, 0] * course[:, 1] - steps[:, 1] * course[:, 0])
    before, after = np.append(0.0, length[:-1]), np.append(length[1:], 0.0)
    sudden = length - np.maximum(before, after)
    most = int(sudden.argmax())
    area = np.where(known, outline.area, 0.0) / (outline.area[0] if known[0] else SMALLEST_PX)
    seen = np.minimum(area[1:], area[:-1])
    rest = length * ((before < REST) & (np.append([0.0, 0.0], length[:-2])[: len(length)] < REST))
    still = length * (pace < STILL)
    return {
        "jump_alone": (length - pace).max(), "jump_alone_seen": np.where(seen > 0.5, length - pace, 0).max(),
        "jump_sudden": sudden[most], "jump_sudden_tool": pace[most], "jump_sudden_gap": near[most],
        "jump_sudden_seen": seen[most], "jump_sudden_when": most / len(place),
        "jump_sudden_along": along[most], "jump_sudden_pulled": pulled[most], "jump_sudden_closing": closing[most],
        "jump_unhit": (length - 2 * hit).max(), "jump_unhit_seen": np.where(seen > 0.5, length - 2 * hit, 0).max(),
        "jump_against": np.where(pace > COURSE, -along, 0).max(), "jump_side": np.where(pace > COURSE, side, 0).max(),
        "pulled_step": pulled.max(), "pulled_sum": np.where(near < 1, np.maximum(pulled, 0), 0).sum(),
        "still_moved": still.sum(), "still_jump": still.max(),
        "rest_jump": rest.max(), "rest_jump_gap": (rest * np.minimum(near, 2)).max(),
    }


def _passing(place: Floats, hand: Floats) -> Numbers:
    """How near the tool's path goes by an object that rests meanwhile."""
    apart = hand - place
    way = np.diff(apart, axis=0)
    share = np.clip(-(apart[:-1] * way).sum(1) / np.maximum((way**2).sum(1), 1e-6), 0, 1)
    nearest = np.linalg.norm(apart[:-1] + share[:, None] * way, axis=1)
    rests = np.linalg.norm(np.diff(place, axis=0), axis=1) < REST
    pace = np.linalg.norm(np.diff(hand, axis=0), axis=1)
    return {
        "pass_near": np.where(rests, nearest, FAR).min(),
        "pass_near_fast": np.where(rests & (pace > 2 * REST), nearest, FAR).min(),
        "pass_through": (pace * (rests & (nearest < NEAR))).sum(),
        "tool_inside": (np.linalg.norm(apart, axis=1) < 0.5).mean(),
    }


def _contact(outline: Outline, gap: Floats) -> Numbers:
    """How much of the object's edge is robot, and how much of its hull is not the object."""
    touched = gap <= TOUCH
    return {
        "ring_max": outline.ring.max(), "ring_mean": _mean(outline.ring[touched]),
        "ring_last": outline.ring[-3:].mean(), "hollow_max": outline.hollow.max(),
        "hollow_touch": _mean(outline.hollow[touched]), "hollow_free": outline.hollow[~touched].max(initial=0.0),
    }


def _shapes(outline: Outline, place: Floats, gap: Floats, known: BoolArray) -> Numbers:
    """Logarithms of the outline's measures against the reference frame's."""
    first = 0 if known[0] else int(known.argmax())
    with np.errstate(invalid="ignore"):
        tall, wide = (np.log(outline.spread / outline.spread[first])).T
        area, long = np.log(outline.area / outline.area[first]), np.log(outline.axes[:, 0] / outline.axes[:, 1])
    clear = known & (gap > CLEAR)
    steady = clear[1:] & clear[:-1] & (np.linalg.norm(np.diff(place, axis=0), axis=1) < PLACE)
    start, end = (clear & (np.linalg.norm(place - place[t], axis=1) < PLACE) for t in (0, -1))
    evidence: Numbers = {}
    for name, values in zip(SHAPES, (tall, wide, area, long - long[first])):
        free, seen = values[clear], values[known]
        evidence |= {
            f"outline_{name}_clear_max": free.max(initial=-FAR) if len(free) else 0.0,
            f"outline_{name}_clear_min": free.min(initial=FAR) if len(free) else 0.0,
            f"outline_{name}_clear_last": _median(free[-3:]), f"outline_{name}_seen_last": _median(seen[-3:]),
            f"outline_{name}_seen_most": quantile(seen, 0.85) if len(seen) else 0.0,
            f"outline_{name}_step": np.abs(np.diff(values))[steady].max(initial=0.0),
            f"outline_{name}_start": np.abs(values[start]).max(initial=0.0),
            f"outline_{name}_end": np.ptp(values[end]) if end.any() else 0.0,
        }
    return evidence


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else 0.0


def _median(values: Floats) -> float:
    return float(median(values)) if len(values) else 0.0
