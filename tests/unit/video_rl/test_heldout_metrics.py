"""Metrics that are never trained on, all at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from video_toys import small_codec, toy_clips

from wm_nodes.config.load import load_config, load_video_config
from wm_nodes.config.seed_ranges import HELDOUT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.video_model import NetworkSettings, VideoNetwork
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder, save_video_folder
from wm_nodes.video_model.success_reader import SuccessReader, load_success_reader, reader_of, save_success_reader
from wm_nodes.video_rl.clip_faults import FaultLimits
from wm_nodes.video_rl.heldout_metrics import (
    EXECUTED,
    UNREWARDED,
    Unrewarded,
    Yardstick,
    filmed_scene,
    fit_tool_correction,
    load_or_measure_unrewarded,
    make_yardstick,
    measure_clips,
)
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.world_model.position_probe import PositionProbe


def test_the_correction_undoes_a_shrunk_and_shifted_height() -> None:
    truth = np.random.default_rng(0).uniform(0, 0.2, (20, 9, 3)).astype(np.float32)
    seen = truth.copy()
    seen[..., 2] = 0.85 * truth[..., 2] - 0.005
    correction = fit_tool_correction(seen, truth)
    np.testing.assert_allclose(seen @ correction[:3] + correction[3], truth, atol=1e-5)


def test_every_metric_of_a_clip_is_a_number_and_the_other_reader_looks_at_the_last_frame() -> None:
    frames = torch.randint(0, 255, (3, 4, 64, 128, 3), dtype=torch.uint8, generator=torch.manual_seed(0))
    frames[:, :, 0] = 0  # scenery
    truth = np.zeros((3, 4, len(GROUND_TRUTH_NAMES)), np.float32)
    clips = toy_clips(frames, torch.zeros(3, 3, 6), truth)
    reader = SuccessReader(64, 128)
    reader.threshold = float(np.median(reader.read(frames[:, -1])))
    probe = PositionProbe(64, 128)
    simulation = load_config("cpu").simulation
    scene = filmed_scene("push_cube", simulation, 64)
    by = Yardstick(probe, reader, simulation, scene, FaultLimits(0.15, 6), np.eye(4, 3))
    found = measure_clips(frames, probe.read(frames), clips, by, 1)
    assert {"success", "impossible_tool_steps", "object_permanence", "reader_success"} <= found.keys()
    for values in found.values():
        assert values.shape == (3,) and values.dtype == torch.float64 and torch.isfinite(values).all()
    np.testing.assert_array_equal(found["reader_success"], reader.done(frames[:, -1]))
    assert found["reader_success"].sum() == 2


@pytest.mark.slow
def test_both_models_of_a_run_are_measured_in_the_simulator_and_by_the_other_reader(tmp_path: Path) -> None:
    scene = load_config("cpu", {"task": "push_cube", "data.num_workers": 1})
    (bag,) = collect_plan(scripted_plan(scene, 3, HELDOUT), scene, tmp_path / "bags")
    config = load_video_config("outcome", {"evaluation.contexts": 3, "evaluation.executions": 2})
    world = shipped_model("push_cube")
    folder = load_video_folder(world / "video_model_outcome")
    other = load_video_folder(world / "video_model_outcome")
    torch.nn.init.zeros_(list(other.network.parameters())[-1])
    heldout, made = load_clips([bag], 2), list[Yardstick]()

    def yardstick() -> Yardstick:
        reader = reader_of(world / "video_model", "push_cube", world)
        made.append(make_yardstick(folder.codec, heldout, load_probe(world), reader, scene.simulation))
        return made[-1]

    def measure(name: str, clips: Clips, config: VideoRlConfig = config) -> Unrewarded:
        return load_or_measure_unrewarded(tmp_path / name, (folder, other), clips, config, yardstick)

    found = measure("a.json", heldout)
    assert found.before.keys() == found.after.keys() == set(UNREWARDED) and not found.missing
    assert {name: len(values) for name, values in found.after.items()} == {
        name: 2 if name in EXECUTED else 3 for name in UNREWARDED
    }
    assert found.before != found.after
    assert measure("a.json", heldout) == found and len(made) == 1, "what was measured is kept"
    moved = measure("b.json", replace(heldout, seeds=(7, 8, 9)))
    assert moved.missing == dict.fromkeys(EXECUTED, "the simulator's scene of reset seed 7 is not the recording's")
    assert moved.before["reader_success"] == found.before["reader_success"]
    none = measure("c.json", heldout, config.with_values(evaluation=config.evaluation.with_values(executions=0)))
    assert none.missing == dict.fromkeys(EXECUTED, "evaluation.executions is 0")
    heldout = replace(heldout, ground_truth=np.full_like(heldout.ground_truth, np.nan))
    assert measure("d.json", heldout).missing.keys() == set(UNREWARDED)


def test_a_model_of_another_codec_has_no_reader_but_its_own(tmp_path: Path) -> None:
    world = shipped_model("push_cube")
    network = VideoNetwork(NetworkSettings(6, 3, 4, 16, 2))
    save_video_folder(tmp_path, small_codec(), network, {"stride": 2, "num_conditioning": 1}, {})
    assert reader_of(tmp_path, "push_cube", world) is None
    assert reader_of(world / "video_model", "reach", world) is None, "those that are shipped are of push_cube"
    save_success_reader(tmp_path, SuccessReader(64, 128, 0.25), "push_cube", {})
    own, shared = (reader_of(folder, "push_cube", world) for folder in (tmp_path, world / "video_model"))
    same_stride = load_success_reader(world / "video_model_outcome", "push_cube")
    assert own is not None and own.threshold == 0.25
    assert shared is not None and shared.threshold == same_stride.threshold
