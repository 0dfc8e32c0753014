"""Faults of clips that no reward knows: what cannot happen in the world, read off the pictures without a recording.

Shapes: N clips, F frames, H W 3 image (cameras side by side), P positions (PROBE_NAMES), K given frames.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.schema import SimulationConfig
from wm_nodes.core.cameras import CameraModel
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.cameras import table_top_cameras
from wm_nodes.environments.maniskill.table_top import CUBE_HALF_SIZE_M
from wm_nodes.world_model.validation.open_loop import OBJECT, TOOL

GHOST_STEP_M, GHOST_DISTANCE_M = 0.02, 0.10
STEP_QUANTILE, PIXEL_QUANTILE = 0.99, 0.01
CHROMA_DISTANCE, DARK = 0.2, 60
"""A pixel has the object's colour when its r g b, as shares of their sum, differ from the object's by less than this in
sum, and their sum, of 765, is above DARK."""
NEAR_OBJECT, NEAR_TOOL = 0.14, 0.2
"""Shares of a picture's height: nearer pixels are not scenery. The hand is above the tool, and is as wide."""


@dataclass(frozen=True)
class FaultLimits:
    """Measured on recordings. tool_step_m: longest possible tool step between two frames. object_px: least number of
    the object's pixels in a frame, of all cameras together; the hand hides it from one, hardly ever from both."""

    tool_step_m: float
    object_px: float


@dataclass(frozen=True)
class ClipFaults:
    """Per clip, float64 (N,). ghost_motion: share of generated steps in which the object moves by more than 2 cm while
    the tool's point is more than 10 cm (3-D) from the object's centre in both frames. impossible_tool_steps: share of
    tool steps longer than the limit. object_permanence: 1 where the last frame shows at least the limit of pixels that
    have the colour which the first frame shows at the object's place. object_px: their number. scenery_change: mean
    absolute change since the first frame, [0, 1], of the still cameras' pixels far from tool and object.
    """

    ghost_motion: Tensor
    impossible_tool_steps: Tensor
    object_permanence: Tensor
    object_px: Tensor
    scenery_change: Tensor

    def named(self) -> dict[str, Tensor]:
        return dict(vars(self))


def measure_fault_limits(frames: Tensor, positions: FloatArray, simulation: SimulationConfig) -> FaultLimits:
    """Return the 0.99 quantile of tool steps, and the 0.01 quantile of the object's pixels in last frames, of recorded
    clips, uint8 (N, F, H, W, 3), that went through the codec of the clips to be compared, at their stride.

    positions: what the probe reads in them, (N, F, P).
    """
    return FaultLimits(
        float(np.quantile(_step_lengths(positions, TOOL), STEP_QUANTILE)),
        float(np.quantile(_object_pixels(frames.cpu().numpy(), positions, simulation), PIXEL_QUANTILE)),
    )


def find_faults(
    frames: Tensor, positions: FloatArray, limits: FaultLimits, simulation: SimulationConfig, num_conditioning: int
) -> ClipFaults:
    """Return the faults of the frames after the first `num_conditioning` of decoded clips, uint8 (N, F, H, W, 3).

    Args:
        positions: what the probe reads in them, (N, F, P), m.
        simulation: cameras of the pictures.

    Raises:
        ValueError: no given frame, or no still camera.
    """
    if num_conditioning < 1:
        raise ValueError(f"faults are changes since a given frame, got num_conditioning {num_conditioning}")
    images, generated = frames.cpu().numpy(), positions[:, num_conditioning - 1 :]
    height = np.full((*generated.shape[:2], 1), CUBE_HALF_SIZE_M, np.float32)
    away = np.linalg.norm(np.concatenate([generated[..., OBJECT], height], -1) - generated[..., TOOL], axis=-1)
    untouched = np.minimum(away[:, :-1], away[:, 1:]) > GHOST_DISTANCE_M
    pixels = _object_pixels(images, positions, simulation)
    values = (
        (untouched & (_step_lengths(generated, OBJECT) > GHOST_STEP_M)).mean(1),
        (_step_lengths(generated, TOOL) > limits.tool_step_m).mean(1),
        pixels >= limits.object_px,
        pixels,
        _scenery_change(images, positions, simulation, num_conditioning),
    )
    return ClipFaults(*(torch.from_numpy(np.asarray(value, np.float64)) for value in values))


def _step_lengths(positions: FloatArray, which: list[int]) -> FloatArray:
    """(N, F - 1), m."""
    lengths: FloatArray = np.linalg.norm(np.diff(positions[..., which], axis=1), axis=-1)
    return lengths


def _object_pixels(images: UInt8Array, positions: FloatArray, simulation: SimulationConfig) -> NDArray[np.int64]:
    """Return how many pixels of the last frame, of all cameras, have the colour of the object, (N,): that of the first
    frame's 3 x 3 pixels where the probe sees the object's centre."""
    size = images.shape[2]
    index, camera = _still_cameras(simulation, size)[0]
    column, row = _places(positions[:, 0], camera)[0].round().astype(int).clip(1, size - 2).T
    column, clip = column + index * size, np.arange(len(images))
    near = [images[clip, 0, row + v, column + u] for v in (-1, 0, 1) for u in (-1, 0, 1)]
    colour = np.mean(near, axis=0)[:, None, None]
    last = images[:, -1].astype(np.float64)
    total = last.sum(-1)
    chroma = last / np.maximum(total, 1)[..., None] - colour / np.maximum(colour.sum(-1, keepdims=True), 1)
    found: NDArray[np.int64] = ((np.abs(chroma).sum(-1) < CHROMA_DISTANCE) & (total > DARK)).sum((1, 2))
    return found


def _scenery_change(
    images: UInt8Array, positions: FloatArray, simulation: SimulationConfig, num_conditioning: int
) -> FloatArray:
    """See ClipFaults.scenery_change, (N,)."""
    size, changes = images.shape[2], []
    for index, camera in _still_cameras(simulation, size):
        views = images[:, :, :, index * size : (index + 1) * size].astype(np.int16)
        taken = _near_things(positions, camera)
        scenery = ~(taken[:, num_conditioning:] | taken[:, :1])
        change = np.abs(views[:, num_conditioning:] - views[:, :1]).sum(-1) / (3 * 255)
        changes.append((change * scenery).sum((1, 2, 3)) / np.maximum(scenery.sum((1, 2, 3)), 1))
    mean: FloatArray = np.mean(changes, axis=0)
    return mean


def _near_things(positions: FloatArray, camera: CameraModel) -> BoolArray:
    """Return where a camera sees the object, the tool or the hand above it, (N, F, H, W)."""
    thing, tool = (places[..., None].astype(np.float32) for places in _places(positions, camera))
    columns, rows = np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32)
    squared = np.square(columns - thing[..., 0, :])[..., None, :] + np.square(rows - thing[..., 1, :])[..., None]
    reach = NEAR_TOOL * camera.height
    beside, above = np.abs(columns - tool[..., 0, :]) < reach, rows - tool[..., 1, :] < reach / 2
    near: BoolArray = (squared < (NEAR_OBJECT * camera.height) ** 2) | (beside[..., None, :] & above[..., None])
    return near


def _places(positions: FloatArray, camera: CameraModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a camera sees the object's centre and the tool, each (..., 2), px: column, row."""
    height = np.full((*positions.shape[:-1], 1), CUBE_HALF_SIZE_M, np.float32)
    to_camera = np.linalg.inv(camera.pose_in())
    seen = []
    for world in (np.concatenate([positions[..., OBJECT], height], -1), positions[..., TOOL]):
        ahead = ((world - ROBOT_BASE) @ to_camera[:3, :3].T + to_camera[:3, 3]) @ camera.K.T
        seen.append(ahead[..., :2] / ahead[..., 2:])
    return seen[0], seen[1]


def _still_cameras(simulation: SimulationConfig, size: int) -> list[tuple[int, CameraModel]]:
    """Return the cameras that do not move, for pictures `size` px high, and which view of a frame is theirs."""
    cameras = table_top_cameras(simulation.model_copy(update={"image_size": size}), lambda _: np.eye(4))
    still = [(index, camera) for index, camera in enumerate(cameras) if not camera.moves]
    if not still:
        raise ValueError(f"cameras {simulation.cameras} all move; faults are read in a still one, such as side")
    return still
