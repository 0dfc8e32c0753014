"""Metrics of clips that are never trained on. Shapes: N clips, F frames, H W 3 image, P positions (PROBE_NAMES)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.schema import SimulationConfig
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.replay import execute_paths
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.success_reader import SuccessReader
from wm_nodes.video_rl.clip_faults import FaultLimits, find_faults
from wm_nodes.video_rl.reference_reward import score_clips
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.validation.open_loop import OBJECT, TOOL


def measure_clips(
    frames: Tensor, positions: FloatArray, references: Clips, probe: PositionProbe, reader: SuccessReader,
    limits: FaultLimits, simulation: SimulationConfig, num_conditioning: int,
) -> dict[str, Tensor]:
    """Return by name, float64 (N,), all scores of ClipScores and ClipFaults of decoded clips, uint8 (N, F, H, W, 3),
    `reader_success`: 1 where the other reader sees the task done in the last frame, and `reader_probability` of it.

    positions: what the probe reads in the clips, (N, F, P).
    """
    probability = reader.read(frames[:, -1])
    scores = score_clips(frames, references, probe, num_conditioning).named()
    faults = find_faults(frames, positions, limits, simulation, num_conditioning).named()
    read = {"reader_success": probability >= reader.threshold, "reader_probability": probability}
    return {**scores, **faults, **{name: torch.from_numpy(value.astype(np.float64)) for name, value in read.items()}}


def fit_tool_correction(positions: FloatArray, truth: FloatArray) -> NDArray[np.float64]:
    """Return the least-squares map (4, 3) from tool positions that the probe reads in decoded recordings to the true
    ones, both (N, F, P), with an offset in the last row.

    A codec may make the tool look lower than it is: that of the shipped push_cube does, by 1.1 cm on average and by
    2.3 cm at heights above 12 cm. Uncorrected, paths that pass over the object touch it when they are executed.
    """
    seen = positions[..., TOOL].reshape(-1, 3).astype(np.float64)
    found: NDArray[np.float64] = np.linalg.lstsq(
        np.column_stack([seen, np.ones(len(seen))]), truth[..., TOOL].reshape(-1, 3).astype(np.float64), rcond=None
    )[0]
    return found


def measure_executability(
    positions: FloatArray, references: Clips, correction: NDArray[np.float64], simulation: SimulationConfig,
    stride: int, *, num_workers: int = 1,
) -> dict[str, Tensor]:
    """Return by name, float64 (N,), what comes of the clips' tool paths in the simulator (execute_paths):
    `executed_success`, `executed_object_cm`, `executed_tool_cm`.

    positions: read by the probe in decoded clips, (N, F, P). correction: of fit_tool_correction on recordings; the same
    for all that is compared.
    """
    paths = (positions[..., TOOL] @ correction[:3] + correction[3]).astype(np.float32)
    executed = execute_paths(
        references.task, simulation, references.seeds, paths, positions[:, -1, OBJECT], stride, num_workers=num_workers
    )
    values = {"success": executed.success, "object_cm": executed.object_error_cm, "tool_cm": executed.tool_error_cm}
    return {f"executed_{name}": torch.from_numpy(np.asarray(value, np.float64)) for name, value in values.items()}
