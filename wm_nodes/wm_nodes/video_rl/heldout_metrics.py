"""Metrics of clips that are never trained on. Shapes: N clips, F frames, H W 3 image, P positions."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.environments import SimulationConfig
from wm_nodes.config.tasks import get_task
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.cameras import ROBOT_BASE, still_camera
from wm_nodes.environments.replay import execute_paths
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_model.success_reader import SuccessReader
from wm_nodes.video_model.tokenizer_codec import TokenizerCodec
from wm_nodes.video_rl.clip_faults import FaultLimits, FilmedScene, find_faults, measure_fault_limits
from wm_nodes.video_rl.execution_reward import fit_tool_correction
from wm_nodes.video_rl.reference_reward import score_clips
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.video_rl.validation import measured_once
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.positions import columns_of, probe_targets

UNREWARDED = (
    "executed_success", "executed_object_cm", "reader_success", "object_permanence", "impossible_tool_steps",
)
"""What no reward can weigh. executed_success, executed_object_cm: of the clip's tool path in the simulator: whether the
task is done, and how far the object ends from where the clip shows it. reader_success: whether the other reader sees it
done. The others: see find_faults."""
EXECUTED = UNREWARDED[:2]
SAME_SCENE = 2e-3
"""Most by which a state after a reset may differ from the recorded one, m."""


@dataclass(frozen=True)
class Yardstick:
    """What decoded clips are measured with."""

    probe: PositionProbe
    """Reads positions."""
    reader: SuccessReader | None
    """Reads success, and is another one; None: there is none."""
    simulation: SimulationConfig
    """Of the recordings."""
    scene: FilmedScene
    """Of the recordings."""
    limits: FaultLimits
    """Of what is possible, by recordings that went through the codec."""
    correction: NDArray[np.float64]
    """Of fit_tool_correction, by recordings that went through the codec."""


def make_yardstick(
    codec: TokenizerCodec, recordings: Clips, probe: PositionProbe, reader: SuccessReader | None,
    simulation: SimulationConfig,
) -> Yardstick:
    """Measure limits and correction on recordings. Raises ValueError: no camera stands still, or no state is known."""
    scene = filmed_scene(recordings.task, simulation, recordings.frames.shape[2])
    decoded = codec.decode(codec.encode(recordings.frames))
    seen = probe.read(decoded)
    return Yardstick(
        probe, reader, simulation, scene, measure_fault_limits(decoded, seen, scene),
        fit_tool_correction(
            seen[..., scene.tool], probe_targets(recordings.ground_truth, recordings.task)[..., scene.tool]
        ),
    )


def filmed_scene(task: str, simulation: SimulationConfig, size: int) -> FilmedScene:
    """What pictures `size` px high show of a task in its simulator. Raises ValueError as still_camera."""
    thing, tool = (columns_of(task, name) for name in ("object", "tool"))
    height = get_task(task).judge.object_height_m
    return FilmedScene(*still_camera(simulation, size), ROBOT_BASE, height, thing, tool)


@dataclass(frozen=True)
class Unrewarded:
    """What no reward knows, of two models."""

    before: dict[str, list[float]]
    """Of UNREWARDED by name, a value per context; executed ones of the first contexts alone."""
    after: dict[str, list[float]]
    """The same of the trained model."""
    missing: dict[str, str]
    """By name why one is not measured."""


def load_or_measure_unrewarded(
    path: Path, models: tuple[VideoFolder, VideoFolder], heldout: Clips, config: VideoRlConfig,
    yardstick: Callable[[], Yardstick],
) -> Unrewarded:
    """Measure one ODE clip of each of the first `evaluation.contexts` held-out contexts by both models, before and
    after; read from `path` where they are of the same weights, else written there."""
    def measure() -> dict[str, Any]:
        try:
            by = yardstick()
            (before, missing), (after, missing_after) = (_measure(model, heldout, by, config) for model in models)
        except ValueError as error:
            return {"before": {}, "after": {}, "missing": dict.fromkeys(UNREWARDED, str(error))}
        missing |= missing_after
        known = [name for name in UNREWARDED if name not in missing]
        first, last = ({name: some[name].tolist() for name in known} for some in (before, after))
        return {"before": first, "after": last, "missing": missing}

    weights = [pack_weights(model.network).sha256 for model in models]
    of = {"sha256": weights, "evaluation": config.evaluation.model_dump(), "names": list(UNREWARDED)}
    return Unrewarded(**measured_once(path, of, measure))


def _measure(
    folder: VideoFolder, heldout: Clips, by: Yardstick, config: VideoRlConfig
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All that can be measured, and why something cannot."""
    contexts, missing = heldout.first(config.evaluation.contexts), dict[str, str]()
    frames = sample_by_ode(folder, contexts, config, config.evaluation.num_steps)
    positions, count = by.probe.read(frames), min(config.evaluation.executions, len(contexts))
    found = measure_clips(frames, positions, contexts, by, folder.clip["num_conditioning"])
    if by.reader is None:
        missing["reader_success"] = "no success reader for clips of this codec"
    if not count:
        return found, missing | dict.fromkeys(EXECUTED, "evaluation.executions is 0")
    try:
        found |= measure_executability(positions[:count], contexts.first(count), by, folder.clip["stride"])
    except ValueError as error:
        missing |= dict.fromkeys(EXECUTED, str(error))
    return found, missing


def measure_clips(
    frames: Tensor, positions: FloatArray, references: Clips, by: Yardstick, num_conditioning: int
) -> dict[str, Tensor]:
    """Return by name, float64 (N,), all scores of score_clips and find_faults of decoded clips, uint8 (N, F, H, W, 3),
    and where there is a reader `reader_success`: 1 where it sees the task done in the last frame.

    positions: what the probe reads in the clips, (N, F, P).
    """
    found = score_clips(frames, references, by.probe, num_conditioning)
    found |= find_faults(frames, positions, by.limits, by.scene, num_conditioning)
    if by.reader is not None:
        found["reader_success"] = torch.from_numpy(by.reader.done(frames[:, -1]).astype(np.float64))
    return found


def measure_executability(
    positions: FloatArray, references: Clips, by: Yardstick, stride: int
) -> dict[str, Tensor]:
    """Return by name, float64 (N,), what comes of the clips' tool paths in the simulator (execute_paths):
    `executed_success`, `executed_object_cm`.

    positions: read by the probe in decoded clips, (N, F, P).

    Raises:
        ValueError: as execute_paths; the scene of a reset seed is not the recording's.
    """
    paths = (positions[..., by.scene.tool] @ by.correction[:3] + by.correction[3]).astype(np.float32)
    executed = execute_paths(
        references.task, by.simulation, references.seeds, paths, positions[:, -1, by.scene.thing], stride
    )
    recorded = references.ground_truth[:, 0]
    other = [not np.allclose(*both, atol=SAME_SCENE) for both in zip(executed.starts, recorded, strict=True)]
    if any(other):
        seed = references.seeds[other.index(True)]
        raise ValueError(f"the simulator's scene of reset seed {seed} is not the recording's")
    values = zip(EXECUTED, (executed.success, executed.object_error_cm), strict=True)
    return {name: torch.from_numpy(np.asarray(value, np.float64)) for name, value in values}
