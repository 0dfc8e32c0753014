"""How the camera moved: shift, roll and zoom between neighbouring frames (RA-17).

Shapes: T frames, H W image. One Gauss-Newton step of Lucas-Kanade per pair of frames, on blurred pictures of the scene
without robot and objects, with a similarity of four numbers: right, down, turn (rad), growth. What moves on its own all
the same is weighted down by what the step leaves unexplained, twice.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.evidence.pictures import GRID, Floats, shrink

BLUR_PX = 1.2
"""Of a picture of GRID x GRID."""
ROUNDS = 3
SOFT_LEVELS = 3.0
"""A pixel that stays this far off, in grey levels, counts half."""
WIDTH_PX = 96.0
"""Shifts are given in px of a picture this wide."""



def registration_evidence(greys: UInt8Array, scene: NDArray[np.bool_]) -> dict[str, float]:
    """Camera evidence.

    Args:
        greys: uint8 (1 + T, H, W), the reference frame first. scene: bool (1 + T, GRID, GRID), only scene is there.
    """
    images = np.stack([cv2.GaussianBlur(shrink(grey, GRID), (0, 0), BLUR_PX) for grey in greys])
    around = np.ones((5, 5), np.uint8)  # the blur spreads what is no scene
    open_cells = np.stack([cv2.erode(mask.astype(np.uint8), around, borderValue=1) for mask in scene])
    moves, left = camera_moves(images, (open_cells[1:] * open_cells[:-1]).astype(np.float32))
    start, steps = moves[0], moves[1:]
    scale = WIDTH_PX / GRID
    path = np.cumsum(steps, 0)
    shift, total = np.hypot(steps[:, 0], steps[:, 1]) * scale, np.hypot(path[:, 0], path[:, 1]) * scale
    still = np.abs(images[1:] - images[0]).mean((1, 2))
    return {
        "camera_start": float(np.hypot(start[0], start[1]) * scale), "camera_shift": float(total[-1]),
        "camera_turn": float(np.degrees(np.abs(path[-1, 2]))), "camera_growth": float(np.abs(path[-1, 3])),
        "camera_shake": float(np.median(shift)), "camera_shake_mean": float(shift.mean()),
        "camera_turning": float(np.degrees(np.median(np.abs(steps[:, 2])))), "camera_left": float(left[1:].mean()),
        "camera_difference": float(still[-1]),
    }


def camera_moves(images: Floats, counted: Floats) -> tuple[Floats, Floats]:
    """Return moves (T, 4) from each image to the next, and the mean weighted difference left over, (T,), grey levels.

    Args:
        images: float32 (1 + T, H, W), blurred. counted: float32 (T, H, W), weight of each pixel.
    """
    height, width = images.shape[1:]
    across = (np.arange(width, dtype=np.float32) - (width - 1) / 2)[None, None]
    along = (np.arange(height, dtype=np.float32) - (height - 1) / 2)[None, :, None]
    middle = (images[1:] + images[:-1]) / 2
    down, right = np.zeros_like(middle), np.zeros_like(middle)
    right[:, :, 1:-1], down[:, 1:-1] = (middle[:, :, 2:] - middle[:, :, :-2]) / 2, (middle[:, 2:] - middle[:, :-2]) / 2
    planes = np.stack([right, down, along * right - across * down, across * right + along * down])
    planes = planes.reshape(4, len(middle), -1)
    slopes = np.ascontiguousarray(planes.transpose(1, 2, 0))
    change = (images[1:] - images[:-1]).reshape(len(middle), -1)
    counts = counted.reshape(len(middle), -1)
    weight, moves = counts, np.zeros((len(middle), 4), np.float32)
    ridge = np.diag([1.0, 1.0, height * width / 8, height * width / 8]).astype(np.float32) * 20
    left = change
    for _ in range(ROUNDS):
        weighted = slopes * weight[..., None]
        normal = weighted.transpose(0, 2, 1) @ slopes + ridge
        moves = np.linalg.solve(normal, -_total(planes * weight * change).T[..., None])[..., 0]
        left = change + (slopes @ moves[..., None])[..., 0]
        weight = counts / (1 + (left / SOFT_LEVELS) ** 2)
    return moves, (np.abs(left) * weight).sum(1) / (weight.sum(1) + 1)


def _total(planes: Floats) -> Floats:
    """(4, T), sums of (4, T, H W) pixel by pixel: sums of whole rows are quick, and those of four numbers are not."""
    rows = np.ascontiguousarray(planes.reshape(-1, planes.shape[2]).T)
    total: Floats = rows.sum(0).reshape(planes.shape[:2])
    return total
