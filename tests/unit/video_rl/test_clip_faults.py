"""Faults of clips, on pictures that are drawn where the simulator's camera would see the things."""

import numpy as np
import pytest
import torch
from torch import Tensor

from wm_nodes.config.load import load_config
from wm_nodes.core.types import FloatArray
from wm_nodes.video_rl.clip_faults import FaultLimits, find_faults, measure_fault_limits, object_seen_at
from wm_nodes.video_rl.heldout_metrics import filmed_scene
from wm_nodes.world_model.positions import position_names

SIMULATION = load_config("smoke").simulation
SCENE = filmed_scene("push_cube", SIMULATION, 64)
NAMES = position_names("push_cube")
LIMITS = FaultLimits(tool_step_m=0.15, object_px=6)
TOOL_X = NAMES.index("tool_x")
GREEN, TABLE = (20, 160, 40), (200, 190, 170)


def still(frames: int = 5) -> FloatArray:
    """One clip in which nothing moves: the tool 20 cm beside the object and 10 cm above it."""
    at = dict.fromkeys(NAMES, 0.0) | {"tool_x": 0.2, "tool_z": 0.12, "goal_x": 0.2}
    return np.tile(np.array([at[name] for name in NAMES], np.float32), (1, frames, 1))


def drawn(positions: FloatArray) -> Tensor:
    """Two views; the left one has a square of 6 x 6 px where the side camera sees the object."""
    images = np.full((*positions.shape[:2], 64, 128, 3), TABLE, np.uint8)
    for frame, (column, row) in enumerate(object_seen_at(positions[0], SCENE).round().astype(int)):
        images[0, frame, row - 3 : row + 3, 64 * SCENE.view + column - 3 : 64 * SCENE.view + column + 3] = GREEN
    return torch.from_numpy(images)


def faults(positions: FloatArray, frames: Tensor | None = None) -> dict[str, float]:
    found = find_faults(drawn(positions) if frames is None else frames, positions, LIMITS, SCENE, 1)
    assert all(value.dtype == torch.float64 and value.shape == (1,) for value in found.values())
    return {name: float(value) for name, value in found.items()}


def test_a_clip_in_which_nothing_happens_has_no_faults() -> None:
    assert faults(still()) == {"impossible_tool_steps": 0, "object_permanence": 1}


def test_a_tool_step_above_the_limit_counts() -> None:
    positions = still()
    positions[0, 3:, TOOL_X] += 0.16
    assert faults(positions)["impossible_tool_steps"] == 0.25


def test_an_object_that_vanishes_is_missed_whatever_its_colour_and_another_view_of_it_is_enough() -> None:
    positions, frames = still(), drawn(still())
    frames[0, -1, :, :64] = torch.tensor(TABLE, dtype=torch.uint8)
    found = faults(positions, frames)
    assert found["object_permanence"] == 0
    frames[0, -1, 10:20, 80:90] = torch.tensor(GREEN, dtype=torch.uint8)
    assert faults(positions, frames)["object_permanence"] == 1


def test_limits_are_quantiles_of_recordings() -> None:
    positions = np.tile(still(3), (200, 1, 1))
    positions[:, 2, TOOL_X] += np.linspace(0, 0.199, 200, dtype=np.float32)
    positions[:, 1, TOOL_X] = positions[:, 2, TOOL_X]
    limits = measure_fault_limits(drawn(still(3)).expand(200, -1, -1, -1, -1), positions, SCENE)
    assert limits.tool_step_m == pytest.approx(0.195, abs=2e-3) and limits.object_px == 36


def test_no_given_frame_no_still_camera_and_another_size_are_refused() -> None:
    positions, frames = still(), drawn(still())
    with pytest.raises(ValueError, match="num_conditioning 0"):
        find_faults(frames, positions, LIMITS, SCENE, 0)
    moving = SIMULATION.model_copy(update={"cameras": ["wrist"]})
    with pytest.raises(ValueError, match=r"wrist.*still one"):
        filmed_scene("push_cube", moving, 64)
    with pytest.raises(ValueError, match="clips are 32 px high"):
        find_faults(frames[:, :, 32:], positions, LIMITS, SCENE, 1)
