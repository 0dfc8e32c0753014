"""Evidence from masks: what scene, object, robot and clutter look like against the reference frame. Section 4.1.

Shapes: T frames, H W 3 image, S tiles along each side. Every number is finite; a region that is nowhere counts as
unchanged, objects.py says that it is missing.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.reward.evidence.objects import HUES_DEGREES, SMALLEST_PX, track
from wm_nodes.reward.evidence.registration import SIDE as GRID
from wm_nodes.reward.evidence.registration import registration_evidence
from wm_nodes.reward.evidence.segmentation import CLUTTER, OBJECT, ROBOT, SCENE
from wm_nodes.types import UInt8Array

TILES = 6
CHANGED_LEVELS = 10.0
TURN = np.exp(2j * np.pi / 3 * np.arange(3)).astype(np.complex64)
"""Chroma is r + g exp(2 pi i / 3) + b exp(4 pi i / 3): its angle is the hue, its length the colourfulness."""

Floats = NDArray[np.float32]
Numbers = dict[str, float]


def region_evidence(frames: UInt8Array, reference: UInt8Array, masks: UInt8Array, instruction: str) -> Numbers:
    """Evidence of one clip.

    Args:
        frames: uint8 (T, H, W, 3). reference: uint8 (H, W, 3). masks: uint8 (1 + T, H, W), the reference frame's first.
    """
    pictures = np.concatenate([reference[None], frames])
    means = {label: _means(pictures, masks == label) for label in (ROBOT, OBJECT)}
    colours = [word for word in instruction.lower().split() if word in HUES_DEGREES]
    greys = np.stack([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures])
    scene = np.stack([_shrunk((mask == SCENE).astype(np.float32), GRID) > 0.99 for mask in masks])
    return {
        **_scene(pictures, greys, scene),
        **registration_evidence(greys, scene),
        **_clutter(masks),
        **_hue(means[OBJECT]),
        **_paint(means[OBJECT], "object"),
        **_paint(means[ROBOT], "robot"),
        **_named(means[OBJECT], colours),
        **_robot(masks == ROBOT),
        "share_unsure": float((masks[1:] != _smoothed(masks[1:])).mean()),
    }


def _smoothed(masks: UInt8Array) -> UInt8Array:
    """Each mask after a 3 x 3 median: speckles are where the segmentation is not sure."""
    return np.stack([cv2.medianBlur(mask, 3) for mask in masks])


def _scene(pictures: UInt8Array, greys: UInt8Array, open_cells: NDArray[np.bool_]) -> Numbers:
    """The scene where it is in view, in the clip and in the reference frame: colour, texture, things that are gone."""
    cells = np.stack([_shrunk(picture, GRID) for picture in pictures])
    both = open_cells[1:] & open_cells[0]
    detail = np.stack([_shrunk(np.abs(cv2.Laplacian(grey, cv2.CV_16S)), GRID) for grey in greys])
    away = np.abs(cells[1:] - cells[0]).mean(3) * both
    share = both.mean((1, 2)) + 1e-6
    mean = away.mean((1, 2)) / share
    inside = [c[m] for c, m in zip(cells[1:], both)]
    shifts = [np.median(c - cells[0][m], axis=0) if len(c) else np.zeros(3) for c, m in zip(inside, both)]
    offset = np.linalg.norm(shifts, axis=1)
    spread = np.array([c.std(0).mean() if len(c) else 0.0 for c in inside])
    changed = ((away > CHANGED_LEVELS) & both).mean((1, 2)) / share
    texture = ((detail[1:] * both).mean((1, 2)) / share + 0.2) / ((detail[0] * both).mean((1, 2)) / share + 0.2)
    part = _tiles(both)
    tiles, parts = _tiles(away) / (part + 0.05), part > 0.3
    kept = (_tiles(detail[1:] * both) + 0.1) / (_tiles(detail[0] * both) + 0.1)
    first = cells[0][open_cells[0]]
    return {
        "scene_away_mean": float(mean.mean()), "scene_away_first": float(mean[0]), "scene_away_last": float(mean[-1]),
        "scene_away_step": float(np.diff(mean).max()),
        "scene_tile_away_low": float(np.quantile(tiles[-1], 0.3)), "scene_changed": float(changed.mean()),
        "scene_changed_last": float(changed[-1]), "scene_changed_first": float(changed[0]),
        "scene_offset_last": float(offset[-1]), "scene_offset_max": float(offset.max()),
        "scene_offset_step": float(np.abs(np.diff(offset)).max()), "scene_texture": float(texture.mean()),
        "scene_texture_min": float(texture.min()),
        "scene_tile_texture": float(kept[parts].min()) if parts.any() else 1.0,
        "scene_spread": float(spread.mean() / (first.std(0).mean() + 1 if len(first) else 1.0)),
        "scene_share": float(share.mean()),
    }  # fmt: skip


def _shrunk(image: NDArray[np.generic], side: int) -> Floats:
    shrunk: Floats = cv2.resize(image.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)
    return shrunk


def _tiles(cells: NDArray[np.generic]) -> Floats:
    """(T, TILES, TILES), means of cells (T, GRID, GRID)."""
    side = GRID // TILES
    return np.asarray(cells.astype(np.float32).reshape(len(cells), TILES, side, TILES, side).mean((2, 4)))


def _clutter(masks: UInt8Array) -> Numbers:
    """Of each uninvolved thing of the reference frame: is something still there that is no scene?"""
    number, labels = cv2.connectedComponents((masks[0] == CLUTTER).astype(np.uint8), connectivity=8)
    things = [labels == i for i in range(1, number)]
    kept = [(masks[1:][:, thing] != SCENE).mean(1) for thing in things if thing.sum() >= SMALLEST_PX]
    share = np.array(kept) if kept else np.ones((1, len(masks) - 1))
    area = (masks == CLUTTER).sum((1, 2)).astype(np.float64)
    late = share[:, len(share[0]) // 2 :].mean(1)
    return {
        "clutter_kept": float(late.mean()), "clutter_kept_least": float(late.min()),
        "clutter_area": float((area[1:].mean() + 5) / (area[0] + 5)),
        "clutter_area_last": float((area[-1] + 5) / (area[0] + 5)),
    }  # fmt: skip


def _means(pictures: UInt8Array, region: NDArray[np.bool_]) -> Floats:
    """(1 + T, 3) mean colour; NaN where the region is too small."""
    count = region.sum((1, 2)).astype(np.float32)
    total = np.stack([picture[mask].sum(0, dtype=np.float32) for picture, mask in zip(pictures, region)])
    return np.where(count[:, None] >= SMALLEST_PX, total / np.maximum(count, 1)[:, None], np.nan)


def _paint(means: Floats, name: str) -> Numbers:
    """Colour of a region against the reference frame's, over the frames that show it, apart from brightness."""
    shown = means[1:][np.isfinite(means[1:, 0])]
    if not len(shown) or not np.isfinite(means[0, 0]):
        return {f"{name}_repainted": 0.0, f"{name}_repainted_max": 0.0}
    scale = means[0].mean() / np.maximum(shown.mean(1), 1)
    paint = np.linalg.norm(shown * scale[:, None] - means[0], axis=1)
    return {f"{name}_repainted": float(np.median(paint)), f"{name}_repainted_max": float(paint.max())}


def _hue(means: Floats) -> Numbers:
    """Hue and chroma of the object against the reference frame's. A robot is grey, its hue says nothing."""
    shown = means[1:][np.isfinite(means[1:, 0])]
    if not len(shown) or not np.isfinite(means[0, 0]):
        return {"object_hue_turn": 0.0, "object_hue_turn_last": 0.0, "object_colourful": 0.0}
    chroma, chroma0 = shown @ TURN, means[0] @ TURN
    hue = np.degrees(np.abs(np.angle(chroma * np.conj(chroma0))))
    return {
        "object_hue_turn": float(np.median(hue)), "object_hue_turn_last": float(hue[-1]),
        "object_colourful": float((np.abs(chroma).mean() - abs(chroma0)) / (means[0].mean() + 1)),
    }  # fmt: skip


def _named(means: Floats, colours: list[str]) -> Numbers:
    """Hue of the object against the one that the instruction names, degrees; 0 where it names none."""
    shown = means[1:][np.isfinite(means[1:, 0])]
    if not colours or not len(shown):
        return {"named_hue_off": 0.0}
    off = np.angle((shown @ TURN) * np.exp(-1j * np.radians(HUES_DEGREES[colours[0]])))
    return {"named_hue_off": float(np.degrees(np.median(np.abs(off))))}


def _robot(arm: NDArray[np.bool_]) -> Numbers:
    """Whether the arm is whole: blobs and area. arm: bool (1 + T, H, W)."""
    area = arm.sum((1, 2)).astype(np.float64)
    second = track(arm).second / (area + 20)
    return {
        "robot_second_max": float(second[1:].max()),
        "robot_first": float((area[1] + 20) / (area[0] + 20)),
        "robot_area_max": float(area.max() / arm[0].size),
        "robot_area_step": float(np.abs(np.diff(area)).max() / (area.max() + 20)),
    }  # fmt: skip
