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
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array

GHOST_STEP_M, GHOST_DISTANCE_M = 0.02, 0.10
STEP_QUANTILE, PIXEL_QUANTILE = 0.99, 0.01
CHROMA_DISTANCE, DARK = 0.2, 60
"""A pixel has the object's colour when its r g b, as shares of their sum, differ from the object's by less than this in
sum, and their sum, of 765, is above DARK."""
NEAR_OBJECT, NEAR_TOOL = 0.14, 0.2
"""Shares of a picture's height: nearer pixels are not scenery. The hand is above the tool, and is as wide."""


@dataclass(frozen=True)
class FilmedScene:
    """What the pictures of a task show."""

    cameras: Sequence[tuple[int, CameraModel]]
    """Those that do not move, and which view of a frame is theirs."""
    robot_base_m: FloatArray
    """Origin (3,) of the cameras' frame in the world, whose axes it has."""
    object_height_m: float
    """Of the object's middle."""
    thing: Sequence[int]
    """Which of the positions (P,) are the object's."""
    tool: Sequence[int]
    """Which are the tool's."""

    def places(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The object's centre and the tool in the world, each (..., 3), m."""
        height = np.full((*positions.shape[:-1], 1), self.object_height_m, np.float32)
        return np.concatenate([positions[..., self.thing], height], -1), positions[..., self.tool]


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

    ghost_motion: share of generated steps in which the object moves by more than 2 cm while the tool's point is more
    than 10 cm (3-D) from the object's centre in both frames. impossible_tool_steps: share of tool steps longer than the
    limit. object_permanence: 1 where the last frame shows at least the limit of pixels that have the colour which the
    first frame shows at the object's place. scenery_change: mean absolute change since the first frame, [0, 1], of the
    still cameras' pixels far from tool and object.

    Args:
        positions: what the probe reads in them, (N, F, P), m.
        scene: of the pictures.

    Raises:
        ValueError: no given frame, or pictures of another size than the cameras'.
    """
    if num_conditioning < 1:
        raise ValueError(f"faults are changes since a given frame, got num_conditioning {num_conditioning}")
    images, generated = frames.cpu().numpy(), positions[:, num_conditioning - 1 :]
    if images.shape[2] != scene.cameras[0][1].height:
        raise ValueError(f"clips are {images.shape[2]} px high, the cameras' pictures {scene.cameras[0][1].height} px")
    away = np.linalg.norm(np.subtract(*scene.places(generated)), axis=-1)
    untouched = np.minimum(away[:, :-1], away[:, 1:]) > GHOST_DISTANCE_M
    values = {
        "ghost_motion": (untouched & (_step_lengths(generated, scene.thing) > GHOST_STEP_M)).mean(1),
        "impossible_tool_steps": (_step_lengths(generated, scene.tool) > limits.tool_step_m).mean(1),
        "object_permanence": _object_pixels(images, positions, scene) >= limits.object_px,
        "scenery_change": _scenery_change(images, positions, scene, num_conditioning),
    }
    return {name: torch.from_numpy(np.asarray(value, np.float64)) for name, value in values.items()}


def _step_lengths(positions: FloatArray, which: Sequence[int]) -> FloatArray:
    """(N, F - 1), m."""
    lengths: FloatArray = np.linalg.norm(np.diff(positions[..., which], axis=1), axis=-1)
    return lengths


def _object_pixels(images: UInt8Array, positions: FloatArray, scene: FilmedScene) -> NDArray[np.int64]:
    """Return how many pixels of the last frame, of all cameras, have the colour of the object, (N,): that of the first
    frame's 3 x 3 pixels where the probe sees the object's centre."""
    index, camera = scene.cameras[0]
    size = camera.height
    column, row = seen_at(positions[:, 0], scene, camera)[0].round().astype(int).clip(1, size - 2).T
    column, clip = column + index * size, np.arange(len(images))
    near = [images[clip, 0, row + v, column + u] for v in (-1, 0, 1) for u in (-1, 0, 1)]
    colour = np.mean(near, axis=0)[:, None, None]
    last = images[:, -1].astype(np.float64)
    total = last.sum(-1)
    chroma = last / np.maximum(total, 1)[..., None] - colour / np.maximum(colour.sum(-1, keepdims=True), 1)
    found: NDArray[np.int64] = ((np.abs(chroma).sum(-1) < CHROMA_DISTANCE) & (total > DARK)).sum((1, 2))
    return found


def _scenery_change(
    images: UInt8Array, positions: FloatArray, scene: FilmedScene, num_conditioning: int
) -> FloatArray:
    """See find_faults, (N,)."""
    size, changes = images.shape[2], []
    for index, camera in scene.cameras:
        views = images[:, :, :, index * size : (index + 1) * size].astype(np.int16)
        taken = _near_things(positions, scene, camera)
        scenery = ~(taken[:, num_conditioning:] | taken[:, :1])
        change = np.abs(views[:, num_conditioning:] - views[:, :1]).sum(-1) / (3 * 255)
        changes.append((change * scenery).sum((1, 2, 3)) / np.maximum(scenery.sum((1, 2, 3)), 1))
    mean: FloatArray = np.mean(changes, axis=0)
    return mean


def _near_things(positions: FloatArray, scene: FilmedScene, camera: CameraModel) -> BoolArray:
    """Return where a camera sees the object, the tool or the hand above it, (N, F, H, W)."""
    thing, tool = (places[..., None].astype(np.float32) for places in seen_at(positions, scene, camera))
    columns, rows = np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32)
    squared = np.square(columns - thing[..., 0, :])[..., None, :] + np.square(rows - thing[..., 1, :])[..., None]
    reach = NEAR_TOOL * camera.height
    beside, above = np.abs(columns - tool[..., 0, :]) < reach, rows - tool[..., 1, :] < reach / 2
    near: BoolArray = (squared < (NEAR_OBJECT * camera.height) ** 2) | (beside[..., None, :] & above[..., None])
    return near


def seen_at(
    positions: FloatArray, scene: FilmedScene, camera: CameraModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a camera sees the object's centre and the tool, each (..., 2), px: column, row."""
    to_camera = np.linalg.inv(camera.pose_in())
    seen = []
    for world in scene.places(positions):
        ahead = ((world - scene.robot_base_m) @ to_camera[:3, :3].T + to_camera[:3, 3]) @ camera.K.T
        seen.append(ahead[..., :2] / ahead[..., 2:])
    return seen[0], seen[1]
