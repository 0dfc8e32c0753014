"""Evidence that needs no model: how a clip differs from its reference frame and from itself (RA-17).

Shapes: T frames, H W 3 image, G grid cells along each side, S tiles along each side. Every number is finite for any
clip of T >= 2 frames; docs/embedded_judge_evidence.csv says what each one is. No number adds reward: heads and
triggers read them.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.evidence.pictures import TURN, ClipPictures, Floats, shrink
from wm_nodes.judge.evidence.quantiles import median, quantile

COARSE = 24
TILES = 6
STILL_LEVELS = 0.15
"""Neighbouring frames whose cells differ by less on average, in grey levels, stand still."""
CHANGED_LEVELS = 10.0
"""A cell that differs by more from the reference frame has changed."""
DARKENED = 0.5
"""A cell with less than this share of its reference brightness is darkened."""
DEAD_DETAIL = 0.45
"""A tile with less than this share of its reference detail has lost it."""

Numbers = dict[str, float]


def pixel_evidence(pictures: ClipPictures) -> Numbers:
    """Evidence of one clip."""
    coarse = np.stack([shrink(cells, COARSE) for cells in pictures.cells[1:]])
    return {
        **_sharpness(pictures.greys), **_exposure(pictures.planes), **_colour(pictures.cells),
        **_agreement(pictures.planes, pictures.away), **_motion(coarse), **_order(coarse),
    }


def _sharpness(greys: UInt8Array) -> Numbers:
    """Fine detail |x - blur(x)|, and its share of coarser detail, against the reference frame. greys: (1 + T, H, W)."""
    smooth = np.stack([cv2.blur(grey, (3, 3)) for grey in greys])
    smoother = np.stack([cv2.blur(grey, (7, 7)) for grey in smooth])
    fine = np.stack([cv2.absdiff(a, b) for a, b in zip(greys, smooth)])
    coarse = np.stack([cv2.absdiff(a, b) for a, b in zip(smooth, smoother)])
    detail = np.stack([shrink(image, TILES) for image in fine])  # (1 + T, S, S)
    share = fine.mean((1, 2)) / (coarse.mean((1, 2)) + 0.5)
    ratio = (detail[1:] + 0.3) / (detail[0] + 0.3)
    total = (detail[1:].mean((1, 2)) + 0.1) / (detail[0].mean() + 0.1)
    against = share[1:] / max(float(share[0]), 1e-3)
    tiles = median(np.moveaxis(ratio, 0, -1))
    return {
        "sharpness_mean": float(against.mean()), "sharpness_min": float(against.min()),
        "sharpness_first": float(against[0]),
        "detail_mean": float(total.mean()), "detail_first": float(total[0]),
        "detail_spread": float(total.std()),
        "tile_detail_low": quantile(tiles, 0.15),
        "tile_detail_lost": float((ratio < DEAD_DETAIL).mean()),
    }


def _exposure(planes: Floats) -> Numbers:
    """Brightness against the reference frame: as a whole, in time (flicker), in places (patches, shadows)."""
    light = planes.mean(0)
    ratio = (light[1:] + 4) / (light[0] + 4)
    gain = _over_cells(ratio)
    bend = np.abs(np.diff(gain, 2)) if len(gain) > 2 else np.zeros(1)
    dark = ratio < DARKENED * gain[:, None, None]
    return {
        "gain_mean": float(gain.mean()), "gain_min": float(gain.min()), "gain_max": float(gain.max()),
        "gain_step": float(np.abs(np.diff(gain)).max()), "flicker": float(bend.mean()),
        "flicker_max": float(bend.max()), "light_contrast": float(light[1:].std((1, 2)).mean() / (light[0].std() + 1)),
        "black_more": float((light[1:] < 10).mean() - (light[0] < 10).mean()), "darkened_mean": float(dark.mean()),
        "darkened_start": float(dark[0].mean()), "darkened_low": quantile(ratio, 0.02),
    }


def _colour(cells: Floats) -> Numbers:
    """Turn of all colours about the grey axis, saturation, cast."""
    chroma = cells @ TURN
    power = float((np.abs(chroma[0]) ** 2).sum()) + 1e-3 * chroma[0].size
    product = (np.conj(chroma[0]) * chroma[1:]).sum((1, 2))
    hue = np.degrees(np.angle(product))
    cast = np.abs(_over_cells(chroma[1:].real - chroma[0].real) + 1j * _over_cells(chroma[1:].imag - chroma[0].imag))
    return {
        "hue_first": float(np.abs(hue[0])), "hue_last": float(np.abs(hue[-1])), "hue_max": float(np.abs(hue).max()),
        "hue_drift": float(np.abs(hue[-1] - hue[0])),
        "chroma_kept": float(np.abs(product).mean() / power), "chroma_kept_min": float(np.abs(product).min() / power),
        "saturation": float((np.abs(chroma[1:]) ** 2).sum((1, 2)).mean() / power),
        "cast_first": float(cast[0]), "cast_last": float(cast[-1]),
        "cast_step": float(np.abs(np.diff(cast)).max()),
    }


def _agreement(planes: Floats, away: Floats) -> Numbers:
    """Difference from the reference frame: how much of the picture, where, and whether it comes at once."""
    changed = away > CHANGED_LEVELS
    typical = _over_cells(away)
    tiles = np.stack([shrink(frame, TILES) for frame in away])
    steps = _over_cells(np.abs(np.diff(planes[:, 1:], axis=1)).mean(0))
    static = np.abs(planes[:, 1:] - planes[:, 1:2]).mean(0).max(0) < CHANGED_LEVELS
    differences = away[-1][static]
    return {
        "reference_first": float(away[0].mean()),
        "reference_median": float(typical.mean()),
        "reference_median_first": float(typical[0]), "changed_first": float(changed[0].mean()),
        "tiles_changed_low": quantile(tiles[-1], 0.25), "tile_changed_most": float(tiles.max()),
        "picture_steps": float(steps.mean()), "static_share": float(static.mean()),
        "static_away": float(differences.mean()) if differences.size else 0.0,
    }


def _over_cells(values: Floats) -> Floats:
    """Medians (T,) of (T, G, G)."""
    return median(values.reshape(len(values), -1))


def _motion(coarse: Floats) -> Numbers:
    """How much moves, when, and how evenly. Energies are mean absolute differences of cells, in grey levels."""
    energy = np.abs(np.diff(coarse, axis=0)).mean((1, 2, 3))
    moving = energy > STILL_LEVELS
    total, where = float(energy.sum()), np.flatnonzero(moving)
    first, last = (int(where[0]), int(where[-1])) if len(where) else (0, len(energy) - 1)
    inside = moving[first : last + 1]
    typical = float(median(energy[moving])) if len(where) else 0.0
    times = (np.arange(len(energy)) + 0.5) / len(energy)
    net = float(np.abs(coarse[-1] - coarse[0]).mean())
    bend = float(np.abs(np.diff(coarse, 2, axis=0)).mean()) if len(coarse) > 2 else 0.0
    return {
        "motion_mean": float(energy.mean()), "motion_still": float(1 - moving.mean()),
        "motion_still_start": first / len(energy) if len(where) else 1.0,
        "motion_still_end": (len(energy) - 1 - last) / len(energy) if len(where) else 1.0,
        "motion_still_within": float(1 - inside.mean()),
        "motion_switches": float(np.abs(np.diff(moving.astype(int))).sum() / len(energy)),
        "motion_jump": float(energy.max() / (typical + 0.2)), "motion_jump_share": float(energy.max() / (total + 0.2)),
        "motion_centre": float((energy * times).sum() / total) if total else 0.5, "motion_net": net,
        "motion_directness": net / (total + 0.2), "motion_bend": bend / (float(energy.mean()) + 0.2),
    }


def _order(coarse: Floats) -> Numbers:
    """Whether neighbours in time are neighbours in the picture: shuffled, repeated and dropped frames."""
    flat = coarse.reshape(len(coarse), -1)
    count = len(flat)
    distance = np.zeros((count, count), np.float32)
    for t in range(1, count):
        distance[t, :t] = distance[:t, t] = np.abs(flat[:t] - flat[t]).mean(1)
    step = np.diagonal(distance, 1)
    moving = step > STILL_LEVELS
    over = np.diagonal(distance, 2)
    wrong = (over < step[:-1]) & moving[:-1] & moving[1:] if count > 2 else np.zeros(1, bool)
    again, runs = np.zeros(count, bool), 0
    furthest = np.maximum.accumulate(np.triu(distance), 1)  # (i, j): of frame i from any of i to j
    for lag in range(2, count):
        left_between = np.diagonal(furthest, lag - 1)[:-1]
        same = (np.diagonal(distance, lag) < STILL_LEVELS) & (left_between > 2 * STILL_LEVELS)
        again[lag:] |= same
        runs = max(runs, _longest_run(same & (step[lag - 1 :] > STILL_LEVELS)))
    nearest = np.where(np.eye(count, dtype=bool), np.inf, distance).min(1)
    jump = step / (0.2 + np.minimum(nearest[1:], nearest[:-1]))
    typical = float(median(step[moving])) if moving.any() else np.inf
    return {
        "order_wrong": float(wrong.sum() / max(1, int(moving.sum()))), "order_again": float(again.mean()),
        "order_again_run": runs / count, "order_gap": float(nearest.max() / (typical + 0.2)),
        "order_jump": float(jump.max()),
        "order_detour": float(step.sum() / (0.2 + _shortest_chain(distance))),
    }


def _longest_run(hits: NDArray[np.bool_]) -> int:
    longest = run = 0
    for hit in hits.tolist():
        run = run + 1 if hit else 0
        longest = max(longest, run)
    return longest


def _shortest_chain(distance: Floats) -> float:
    """Length of the minimum spanning tree of the frames (Prim): the clip in its best order is about as long."""
    best, used, total = distance[0].copy(), np.zeros(len(distance), bool), 0.0
    used[0] = True
    for _ in range(len(distance) - 1):
        new = int(np.where(used, np.inf, best).argmin())
        total += float(best[new])
        used[new] = True
        best = np.minimum(best, distance[new])
    return total
