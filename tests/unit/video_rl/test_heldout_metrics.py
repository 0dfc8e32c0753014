"""Metrics that are never trained on, all at once."""

import numpy as np
import torch

from wm_nodes.config.load import load_config
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.success_reader import SuccessReader
from wm_nodes.video_rl.clip_faults import FaultLimits
from wm_nodes.video_rl.heldout_metrics import fit_tool_correction, measure_clips
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.tokenizer import PROBE_NAMES
from wm_nodes.world_model.validation.open_loop import TOOL


def test_the_correction_undoes_a_shrunk_and_shifted_height() -> None:
    truth = np.random.default_rng(0).uniform(0, 0.2, (20, 9, len(PROBE_NAMES))).astype(np.float32)
    seen = truth.copy()
    seen[..., TOOL[2]] = 0.85 * truth[..., TOOL[2]] - 0.005
    correction = fit_tool_correction(seen, truth)
    np.testing.assert_allclose(seen[..., TOOL] @ correction[:3] + correction[3], truth[..., TOOL], atol=1e-5)


def test_every_metric_of_a_clip_is_a_number_and_the_other_reader_looks_at_the_last_frame() -> None:
    frames = torch.randint(0, 255, (3, 4, 64, 128, 3), dtype=torch.uint8, generator=torch.manual_seed(0))
    truth = np.zeros((3, 4, len(GROUND_TRUTH_NAMES)), np.float32)
    clips = Clips(frames, torch.zeros(3, 3, 6), truth, ("",) * 3, "push_cube")
    reader = SuccessReader(64, 128)
    reader.threshold = float(np.median(reader.read(frames[:, -1])))
    simulation, limits = load_config("cpu").simulation, FaultLimits(0.15, 6)
    probe = PositionProbe(64, 128)
    found = measure_clips(frames, probe.read(frames), clips, probe, reader, limits, simulation, 1)
    assert {"success", "ghost_motion", "object_permanence", "reader_success"} <= found.keys()
    for values in found.values():
        assert values.shape == (3,) and values.dtype == torch.float64 and torch.isfinite(values).all()
    np.testing.assert_allclose(found["reader_probability"], reader.read(frames[:, -1]), atol=1e-6)
    assert found["reader_success"].sum() == 2
