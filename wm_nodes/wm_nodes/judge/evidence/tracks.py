"""Blobs of masks and their way through a clip (RA-17). Shapes: T frames, H W image."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray

SMALLEST_PX = 6
"""A blob of fewer pixels is none."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """The largest blob of a class in each of T frames; NaN where there is none.

    area: (T,) px. centre: (T, 2) row and column. box: (T, 4) top, left, height, width. axes: (T, 2) longer and shorter
    standard deviation, px. second: (T,) area of the next largest blob, px, 0 where there is none.
    """

    area: Floats
    centre: Floats
    box: Floats
    axes: Floats
    second: Floats


def track(masks: BoolArray) -> Track:
    """Follow the largest blob of bool (T, H, W)."""
    count = len(masks)
    nan = np.full((count, 9), np.nan)
    second = np.zeros(count)
    for t, mask in enumerate(masks):
        above, before, labels, stats, centres = _blobs(mask)
        if not len(stats):
            continue
        largest = int(stats[:, cv2.CC_STAT_AREA].argmax())
        left, top, width, height, area = stats[largest].tolist()
        m = cv2.moments((labels[top : top + height, left : left + width] == largest + 1).view(np.uint8), True)
        middle, half = (m["mu20"] + m["mu02"]) / 2, np.hypot((m["mu20"] - m["mu02"]) / 2, m["mu11"])
        # a pixel has an extent, too
        axes = [math.sqrt(max(value, 0.0) / area + 1 / 12) for value in (middle + half, middle - half)]
        # from the whole sum of columns and of rows, so that where the crop begins changes no bit
        column, row = (round(value * area) for value in centres[largest].tolist())
        nan[t] = (
            area, (row + above * area) / area, (column + before * area) / area, above + top, before + left,
            height, width, *axes,
        )
        second[t] = _second(stats)
    small = ~(nan[:, 0] >= SMALLEST_PX)
    nan[small] = np.nan
    return Track(nan[:, 0], nan[:, 1:3], nan[:, 3:7], nan[:, 7:], second)


def second_areas(masks: BoolArray) -> Floats:
    """(T,) px of the next to largest blob of bool (T, H, W), 0 where there is none."""
    return np.array([_second(_blobs(mask)[3]) for mask in masks], np.float64)


def _second(stats: NDArray[np.int32]) -> int:
    return int(np.sort(stats[:, cv2.CC_STAT_AREA])[-2]) if len(stats) > 1 else 0


def _blobs(mask: BoolArray) -> tuple[int, int, NDArray[np.int32], NDArray[np.int32], Floats]:
    """Row and column where a crop around all blobs begins, and in the crop: labels, statistics and centres (x, y).

    The first row of statistics is that of label 1. The crop begins at even places: blobs are numbered in pairs of rows
    and columns, and the first of equals counts.
    """
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    left, width, top, height = left & ~1, width + left % 2, top & ~1, height + top % 2
    crop = mask[top : top + height, left : left + width].view(np.uint8)
    if not crop.size:
        return 0, 0, np.zeros((0, 0), np.int32), np.zeros((0, 5), np.int32), np.zeros((0, 2))
    _, labels, stats, centres = cv2.connectedComponentsWithStats(crop, connectivity=8)
    return top, left, labels, stats[1:], centres[1:]
