"""Evidence that needs no model: how a clip differs from its reference frame and from itself. Section 4.1.

Shapes: T frames, H W 3 image, G grid cells along each side, S tiles along each side. Every number is finite for any
clip of T >= 2 frames; definitions.py says what each one is. No number adds reward: heads and triggers read them.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.types import UInt8Array

GRID = 48
"""Frames are averaged to GRID x GRID cells for colour and motion, so that their size does not matter."""
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

Floats = NDArray[np.float32]
Numbers = dict[str, float]


def pixel_evidence(frames: UInt8Array, reference: UInt8Array) -> Numbers:
    """Evidence of one clip.

    Args:
        frames: uint8 (T, H, W, 3), T >= 2. reference: uint8 (H, W, 3), what the clip had to start from.

    Raises:
        ValueError: wrong shapes or types; names them.
    """
    check_clip(frames, reference)
    together = np.concatenate([reference[None], frames])
    greys = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in together])
    cells = np.stack([_shrunk(frame, GRID) for frame in together])
    coarse = np.stack([_shrunk(frame, COARSE) for frame in cells])
    return {
        **_sharpness(greys),
        **_exposure(cells),
        **_colour(cells),
        **_agreement(cells),
        **_motion(coarse[1:]),
        **_order(coarse[1:]),
    }


def check_clip(frames: UInt8Array, reference: UInt8Array) -> None:
    """Raise ValueError unless frames are uint8 (T >= 2, H, W, 3) and reference is one of that size."""
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or len(frames) < 2:
        raise ValueError(f"frames must be uint8 (T >= 2, H, W, 3), got {frames.dtype} {frames.shape}")
    if reference.dtype != np.uint8 or reference.shape != frames.shape[1:]:
        raise ValueError(
            f"the reference frame must be uint8 {frames.shape[1:]}, got {reference.dtype} {reference.shape}"
        )


def _shrunk(image: NDArray[np.generic], side: int) -> Floats:
    """(side, side, C) float32; area means where the image is larger."""
    shrunk: Floats = cv2.resize(image.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)
    return shrunk


def _sharpness(greys: UInt8Array) -> Numbers:
    """Fine detail |x - blur(x)|, and its share of coarser detail, against the reference frame. greys: (1 + T, H, W)."""
    smooth = np.stack([cv2.blur(grey, (3, 3)) for grey in greys])
    smoother = np.stack([cv2.blur(grey, (7, 7)) for grey in smooth])
    fine = np.stack([cv2.absdiff(a, b) for a, b in zip(greys, smooth)])
    coarse = np.stack([cv2.absdiff(a, b) for a, b in zip(smooth, smoother)])
    detail = np.stack([_shrunk(image, TILES) for image in fine])  # (1 + T, S, S)
    share = fine.mean((1, 2)) / (coarse.mean((1, 2)) + 0.5)
    ratio = (detail[1:] + 0.3) / (detail[0] + 0.3)
    total = (detail[1:].mean((1, 2)) + 0.1) / (detail[0].mean() + 0.1)
    against = share[1:] / max(float(share[0]), 1e-3)
    tiles = np.median(ratio, 0)
    return {
        "sharpness_mean": float(against.mean()), "sharpness_min": float(against.min()),
        "sharpness_first": float(against[0]),
        "detail_mean": float(total.mean()), "detail_first": float(total[0]),
        "detail_spread": float(total.std()),
        "tile_detail_low": float(np.quantile(tiles, 0.15)),
        "tile_detail_lost": float((ratio < DEAD_DETAIL).mean()),
    }  # fmt: skip


def _exposure(cells: Floats) -> Numbers:
    """Brightness against the reference frame: as a whole, in time (flicker), in places (patches, shadows)."""
    light = cells.mean(3)
    ratio = (light[1:] + 4) / (light[0] + 4)
    gain = np.median(ratio, (1, 2))
    bend = np.abs(np.diff(gain, 2)) if len(gain) > 2 else np.zeros(1)
    dark = ratio < DARKENED * gain[:, None, None]
    return {
        "gain_mean": float(gain.mean()), "gain_min": float(gain.min()),
        "gain_max": float(gain.max()), "gain_step": float(np.abs(np.diff(gain)).max()), "flicker": float(bend.mean()),
        "flicker_max": float(bend.max()),
        "light_contrast": float(light[1:].std((1, 2)).mean() / (light[0].std() + 1)),
        "black_more": float((light[1:] < 10).mean() - (light[0] < 10).mean()),
        "darkened_mean": float(dark.mean()),
        "darkened_start": float(dark[0].mean()), "darkened_low": float(np.quantile(ratio, 0.02)),
    }  # fmt: skip


def _colour(cells: Floats) -> Numbers:
    """Turn of all colours about the grey axis, saturation, cast.

    Chroma is r + g exp(2 pi i / 3) + b exp(4 pi i / 3).
    """
    turn = np.exp(2j * np.pi / 3 * np.arange(3)).astype(np.complex64)
    chroma = cells @ turn
    power = float((np.abs(chroma[0]) ** 2).sum()) + 1e-3 * chroma[0].size
    product = (np.conj(chroma[0]) * chroma[1:]).sum((1, 2))
    hue = np.degrees(np.angle(product))
    cast = np.abs(np.median(chroma[1:].real - chroma[0].real, (1, 2)) + 1j * np.median(
        chroma[1:].imag - chroma[0].imag, (1, 2)))  # fmt: skip
    return {
        "hue_first": float(np.abs(hue[0])), "hue_last": float(np.abs(hue[-1])), "hue_max": float(np.abs(hue).max()),
        "hue_drift": float(np.abs(hue[-1] - hue[0])),
        "chroma_kept": float(np.abs(product).mean() / power), "chroma_kept_min": float(np.abs(product).min() / power),
        "saturation": float((np.abs(chroma[1:]) ** 2).sum((1, 2)).mean() / power),
        "cast_first": float(cast[0]), "cast_last": float(cast[-1]),
        "cast_step": float(np.abs(np.diff(cast)).max()),
    }  # fmt: skip


def _agreement(cells: Floats) -> Numbers:
    """Difference from the reference frame: how much of the picture, where, and whether it comes at once."""
    away = np.abs(cells[1:] - cells[0]).mean(3)
    changed = away > CHANGED_LEVELS
    median = np.median(away, (1, 2))
    tiles = np.stack([_shrunk(frame, TILES) for frame in away])
    steps = np.median(np.abs(np.diff(cells[1:], axis=0)).mean(3), (1, 2))
    static = np.abs(cells[1:] - cells[1]).mean(3).max(0) < CHANGED_LEVELS
    kept = away[-1][static]
    return {
        "reference_first": float(away[0].mean()),
        "reference_median": float(median.mean()),
        "reference_median_first": float(median[0]), "changed_first": float(changed[0].mean()),
        "tiles_changed_low": float(np.quantile(tiles[-1], 0.25)), "tile_changed_most": float(tiles.max()),
        "picture_steps": float(steps.mean()), "static_share": float(static.mean()),
        "static_away": float(kept.mean()) if kept.size else 0.0,
    }  # fmt: skip


def _motion(coarse: Floats) -> Numbers:
    """How much moves, when, and how evenly. Energies are mean absolute differences of cells, in grey levels."""
    energy = np.abs(np.diff(coarse, axis=0)).mean((1, 2, 3))
    moving = energy > STILL_LEVELS
    total, where = float(energy.sum()), np.flatnonzero(moving)
    first, last = (int(where[0]), int(where[-1])) if len(where) else (0, len(energy) - 1)
    inside = moving[first : last + 1]
    typical = float(np.median(energy[moving])) if len(where) else 0.0
    times = (np.arange(len(energy)) + 0.5) / len(energy)
    net = float(np.abs(coarse[-1] - coarse[0]).mean())
    bend = float(np.abs(np.diff(coarse, 2, axis=0)).mean()) if len(coarse) > 2 else 0.0
    return {
        "motion_mean": float(energy.mean()), "motion_still": float(1 - moving.mean()),
        "motion_still_start": first / len(energy) if len(where) else 1.0,
        "motion_still_end": (len(energy) - 1 - last) / len(energy) if len(where) else 1.0,
        "motion_still_within": float(1 - inside.mean()),
        "motion_switches": float(np.abs(np.diff(moving.astype(int))).sum() / len(energy)),
        "motion_jump": float(energy.max() / (typical + 0.2)),
        "motion_jump_share": float(energy.max() / (total + 0.2)),
        "motion_centre": float((energy * times).sum() / total) if total else 0.5,
        "motion_net": net, "motion_directness": net / (total + 0.2),
        "motion_bend": bend / (float(energy.mean()) + 0.2),
    }  # fmt: skip


def _order(coarse: Floats) -> Numbers:
    """Whether neighbours in time are neighbours in the picture: shuffled, repeated and dropped frames."""
    flat = coarse.reshape(len(coarse), -1)
    distance = np.stack([np.abs(flat - frame).mean(1) for frame in flat])  # (T, T)
    count = len(flat)
    step = np.diagonal(distance, 1)
    moving = step > STILL_LEVELS
    over = np.diagonal(distance, 2)
    wrong = (over < step[:-1]) & moving[:-1] & moving[1:] if count > 2 else np.zeros(1, bool)
    again, runs = np.zeros(count, bool), 0
    for lag in range(2, count):
        left_between = np.array([distance[t - lag, t - lag : t].max() for t in range(lag, count)])
        same = (np.diagonal(distance, -lag) < STILL_LEVELS) & (left_between > 2 * STILL_LEVELS)
        again[lag:] |= same
        runs = max(runs, _longest_run(same & (step[lag - 1 :] > STILL_LEVELS)))
    nearest = np.where(np.eye(count, dtype=bool), np.inf, distance).min(1)
    jump = step / (0.2 + np.minimum(nearest[1:], nearest[:-1]))
    typical = float(np.median(step[moving])) if moving.any() else np.inf
    return {
        "order_wrong": float(wrong.sum() / max(1, int(moving.sum()))), "order_again": float(again.mean()),
        "order_again_run": runs / count, "order_gap": float(nearest.max() / (typical + 0.2)),
        "order_jump": float(jump.max()),
        "order_detour": float(step.sum() / (0.2 + _shortest_chain(distance))),
    }  # fmt: skip


def _longest_run(hits: NDArray[np.bool_]) -> int:
    longest = run = 0
    for hit in hits:
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
