"""Evidence from masks: what scene, object, robot and clutter look like against the reference frame (RA-17).

Shapes: T frames, H W 3 image, S tiles along each side. Every number is finite; a region that is nowhere counts as
unchanged, objects.py says that it is missing.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, UInt8Array
from wm_nodes.judge.evidence.objects import HUES_DEGREES, Numbers
from wm_nodes.judge.evidence.pictures import GRID, TURN, ClipPictures, Floats, shrink
from wm_nodes.judge.evidence.quantiles import median, quantile
from wm_nodes.judge.evidence.registration import registration_evidence
from wm_nodes.judge.evidence.segmentation import CLUTTER, OBJECT, ROBOT, SCENE
from wm_nodes.judge.evidence.tracks import SMALLEST_PX, second_areas

TILES = 6
CHANGED_LEVELS = 10.0



def region_evidence(pictures: ClipPictures, masks: UInt8Array, instruction: str) -> Numbers:
    """Evidence of one clip. masks: uint8 (1 + T, H, W), the reference frame's first."""
    robot, thing = _means(pictures.colours, masks, (ROBOT, OBJECT))
    colours = [word for word in instruction.lower().split() if word in HUES_DEGREES]
    scene = np.stack([shrink(mask == SCENE, GRID) > 0.99 for mask in masks])
    return {
        **_scene(pictures, scene), **registration_evidence(pictures.greys, scene), **_clutter(masks), **_hue(thing),
        **_paint(thing, "object"), **_paint(robot, "robot"), **_named_hue(thing, colours), **_robot(masks == ROBOT),
        "share_unsure": float((masks[1:] != _smooth(masks[1:])).mean()),
    }


def _smooth(masks: UInt8Array) -> UInt8Array:
    """Each mask after a 3 x 3 median: speckles are where the segmentation is not sure."""
    return np.stack([cv2.medianBlur(mask, 3) for mask in masks])


def _scene(pictures: ClipPictures, open_cells: BoolArray) -> Numbers:
    """The scene where it is in view, in the clip and in the reference frame: colour, texture, things that are gone."""
    both = open_cells[1:] & open_cells[0]
    detail = np.stack([shrink(np.abs(cv2.Laplacian(grey, cv2.CV_16S)), GRID) for grey in pictures.greys])
    away = pictures.away * both
    share = both.mean((1, 2)) + 1e-6
    mean = away.mean((1, 2)) / share
    moved = (pictures.planes[:, 1:] - pictures.planes[:, :1]).swapaxes(0, 1)  # (T, 3, G, G)
    shifts = [median(m[:, shown]) if shown.any() else np.zeros(3) for m, shown in zip(moved, both)]
    offset = np.linalg.norm(shifts, axis=1)
    spread0, *spread = _spread(pictures.planes, np.concatenate([open_cells[:1], both]))
    changed = ((away > CHANGED_LEVELS) & both).mean((1, 2)) / share
    texture = ((detail[1:] * both).mean((1, 2)) / share + 0.2) / ((detail[0] * both).mean((1, 2)) / share + 0.2)
    part = _tiles(both)
    tiles, parts = _tiles(away) / (part + 0.05), part > 0.3
    texture_ratio = (_tiles(detail[1:] * both) + 0.1) / (_tiles(detail[0] * both) + 0.1)
    return {
        "scene_away_mean": float(mean.mean()), "scene_away_first": float(mean[0]), "scene_away_last": float(mean[-1]),
        "scene_away_step": float(np.diff(mean).max()), "scene_tile_away_low": quantile(tiles[-1], 0.3),
        "scene_changed": float(changed.mean()), "scene_changed_last": float(changed[-1]),
        "scene_changed_first": float(changed[0]), "scene_offset_last": float(offset[-1]),
        "scene_offset_max": float(offset.max()), "scene_offset_step": float(np.abs(np.diff(offset)).max()),
        "scene_texture": float(texture.mean()), "scene_texture_min": float(texture.min()),
        "scene_tile_texture": float(texture_ratio[parts].min()) if parts.any() else 1.0,
        "scene_spread": float(np.array(spread).mean() / (spread0 + 1)), "scene_share": float(share.mean()),
    }


def _spread(planes: Floats, chosen: BoolArray) -> list[np.float32 | float]:
    """Standard deviation of chosen cells (T, G, G) of planes (3, T, G, G), T > 1, mean over colours; 0 where none is.

    Cells are added one after the other, those of all frames at once.
    """
    count = np.maximum(chosen.sum((1, 2)), 1).astype(np.float32)
    weights = np.ascontiguousarray(chosen.reshape(len(chosen), -1).T).astype(np.float32)  # (G G, T)
    values = np.ascontiguousarray(planes.reshape(3, len(chosen), -1).swapaxes(1, 2))
    away = (values - (values * weights).sum(1, keepdims=True) / count) * weights
    deviation = np.sqrt((away * away).sum(1) / count).T
    return [row.mean() if shown.any() else 0.0 for row, shown in zip(deviation, chosen)]


def _tiles(cells: NDArray[np.generic]) -> Floats:
    """(T, TILES, TILES), means of cells (T, GRID, GRID)."""
    side = GRID // TILES
    return np.asarray(cells.astype(np.float32).reshape(len(cells), TILES, side, TILES, side).mean((2, 4)))


def _clutter(masks: UInt8Array) -> Numbers:
    """Of each uninvolved thing of the reference frame: is something still there that is no scene?"""
    number, labels = cv2.connectedComponents((masks[0] == CLUTTER).astype(np.uint8), connectivity=8)
    things = [labels == i for i in range(1, number)]
    shares = [(masks[1:][:, thing] != SCENE).mean(1) for thing in things if thing.sum() >= SMALLEST_PX]
    share = np.array(shares) if shares else np.ones((1, len(masks) - 1))
    area = (masks == CLUTTER).sum((1, 2)).astype(np.float64)
    late = share[:, len(share[0]) // 2 :].mean(1)
    return {
        "clutter_kept": float(late.mean()), "clutter_kept_least": float(late.min()),
        "clutter_area": float((area[1:].mean() + 5) / (area[0] + 5)),
        "clutter_area_last": float((area[-1] + 5) / (area[0] + 5)),
    }


def _means(colours: UInt8Array, masks: UInt8Array, labels: tuple[int, ...]) -> Floats:
    """(L, 1 + T, 3) mean colours of L labels; NaN where a region is too small. Sums below 2^24 levels are exact."""
    regions = np.stack([masks == label for label in labels], 1).reshape(len(masks), len(labels), -1)
    count = regions.sum(2).astype(np.float32)[..., None]
    total = regions.astype(np.float32) @ colours.reshape(len(masks), -1, 3).astype(np.float32)
    return np.where(count >= SMALLEST_PX, total / np.maximum(count, 1), np.nan).swapaxes(0, 1)


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
    }


def _named_hue(means: Floats, colours: list[str]) -> Numbers:
    """Hue of the object against the one that the instruction names, degrees; 0 where it names none."""
    shown = means[1:][np.isfinite(means[1:, 0])]
    if not colours or not len(shown):
        return {"named_hue_off": 0.0}
    off = np.angle((shown @ TURN) * np.exp(-1j * np.radians(HUES_DEGREES[colours[0]])))
    return {"named_hue_off": float(np.degrees(np.median(np.abs(off))))}


def _robot(arm: BoolArray) -> Numbers:
    """Whether the arm is whole: blobs and area. arm: bool (1 + T, H, W)."""
    area = arm.sum((1, 2)).astype(np.float64)
    second = second_areas(arm) / (area + 20)
    return {
        "robot_second_max": float(second[1:].max()),
        "robot_first": float((area[1] + 20) / (area[0] + 20)),
        "robot_area_max": float(area.max() / arm[0].size),
        "robot_area_step": float(np.abs(np.diff(area)).max() / (area.max() + 20)),
    }
