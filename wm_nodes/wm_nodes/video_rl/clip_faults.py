"""Faults of clips that no reward knows: what cannot happen in the world, read off the pictures without a recording.

Shapes: N clips, F frames, H W 3 image (cameras side by side), P positions, K given frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.core.cameras import CameraModel
from wm_nodes.core.types import FloatArray, UInt8Array

STEP_QUANTILE, PIXEL_QUANTILE = 0.99, 0.01
CHROMA_DISTANCE, DARK = 0.2, 60
"""A pixel has the object's colour when its r g b, as shares of their sum, differ from the object's by less than this in
sum, and their sum, of 765, is above DARK."""


@dataclass(frozen=True)
class FilmedScene:
    """What the pictures of a task show."""

    view: int
    """Which view of a frame is the camera's."""
    camera: CameraModel
    """One that does not move."""
    robot_base_m: FloatArray
    """Origin (3,) of the cameras' frame in the world, whose axes it has."""
    object_height_m: float
    """Of the object's middle."""
    thing: Sequence[int]
    """Which of the positions (P,) are the object's."""
    tool: Sequence[int]
    """Which are the tool's."""


@dataclass(frozen=True)
class FaultLimits:
    """What recordings show at most, or at least."""

    tool_step_m: float
    """Longest possible tool step between two frames."""
    object_px: float
    """Least number of the object's pixels in a frame, of all cameras together; the hand hides it from one, hardly ever
    from both."""


def measure_fault_limits(frames: Tensor, positions: FloatArray, scene: FilmedScene) -> FaultLimits:
    """Return the 0.99 quantile of tool steps, and the 0.01 quantile of the object's pixels in last frames, of recorded
    clips, uint8 (N, F, H, W, 3), that went through the codec of the clips to be compared, at their stride.

    positions: what the probe reads in them, (N, F, P).
    """
    return FaultLimits(
        float(np.quantile(_step_lengths(positions, scene.tool), STEP_QUANTILE)),
        float(np.quantile(_object_pixels(frames.cpu().numpy(), positions, scene), PIXEL_QUANTILE)),
    )


def find_faults(
    frames: Tensor, positions: FloatArray, limits: FaultLimits, scene: FilmedScene, num_conditioning: int
) -> dict[str, Tensor]:
    """Return by name, float64 (N,), the faults of the frames after the first `num_conditioning` of decoded clips, uint8
    (N, F, H, W, 3).

    impossible_tool_steps: share of tool steps longer than the limit. object_permanence: 1 where the last frame shows at
    least the limit of pixels that have the colour which the first frame shows at the object's place.

    Args:
        positions: what the probe reads in them, (N, F, P), m.
        scene: of the pictures.

    Raises:
        ValueError: no given frame, or pictures of another size than the camera's.
    """
    if num_conditioning < 1:
        raise ValueError(f"faults are changes since a given frame, got num_conditioning {num_conditioning}")
    images, generated = frames.cpu().numpy(), positions[:, num_conditioning - 1 :]
    if images.shape[2] != scene.camera.height:
        raise ValueError(f"clips are {images.shape[2]} px high, the camera's pictures {scene.camera.height} px")
    values = {
        "impossible_tool_steps": (_step_lengths(generated, scene.tool) > limits.tool_step_m).mean(1),
        "object_permanence": _object_pixels(images, positions, scene) >= limits.object_px,
    }
    return {name: torch.from_numpy(np.asarray(value, np.float64)) for name, value in values.items()}


def _step_lengths(positions: FloatArray, which: Sequence[int]) -> FloatArray:
    """(N, F - 1), m."""
    lengths: FloatArray = np.linalg.norm(np.diff(positions[..., which], axis=1), axis=-1)
    return lengths


def _object_pixels(images: UInt8Array, positions: FloatArray, scene: FilmedScene) -> NDArray[np.int64]:
    """Return how many pixels of the last frame, of all cameras, have the colour of the object, (N,): that of the first
    frame's 3 x 3 pixels where the probe sees the object's centre."""
    size = scene.camera.height
    column, row = object_seen_at(positions[:, 0], scene).round().astype(int).clip(1, size - 2).T
    column, clip = column + scene.view * size, np.arange(len(images))
    near = [images[clip, 0, row + v, column + u] for v in (-1, 0, 1) for u in (-1, 0, 1)]
    colour = np.mean(near, axis=0)[:, None, None]
    last = images[:, -1].astype(np.float64)
    total = last.sum(-1)
    chroma = last / np.maximum(total, 1)[..., None] - colour / np.maximum(colour.sum(-1, keepdims=True), 1)
    found: NDArray[np.int64] = ((np.abs(chroma).sum(-1) < CHROMA_DISTANCE) & (total > DARK)).sum((1, 2))
    return found


def object_seen_at(positions: FloatArray, scene: FilmedScene) -> NDArray[np.float64]:
    """Return where the camera sees the object's centre, (..., 2), px: column, row."""
    height = np.full((*positions.shape[:-1], 1), scene.object_height_m, np.float32)
    in_robot = np.concatenate([positions[..., scene.thing], height], -1) - scene.robot_base_m
    to_camera = np.linalg.inv(scene.camera.pose_in())
    ahead = (in_robot @ to_camera[:3, :3].T + to_camera[:3, 3]) @ scene.camera.K.T
    seen: NDArray[np.float64] = ahead[..., :2] / ahead[..., 2:]
    return seen
