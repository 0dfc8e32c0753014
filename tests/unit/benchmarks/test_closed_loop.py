"""Closed loop: the controls and their compute, and the command on episodes of noise and an untrained model."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from recording_samples import make_episode, make_spec
from video_toys import tiny_network, weights

from benchmarks.video_rl.closed_loop import (
    BEST,
    PRESET,
    RECORDINGS,
    REWARDS,
    ClosedLoopPlan,
    calls_of_buffer,
    closed_loop_samplers,
    equal_compute,
)
from benchmarks.video_rl.controls import BestAndRecorded, FlowMatchingLearner, RecordedTargets, best_and_worst
from benchmarks.video_rl.samplers import SamplerSetup
from benchmarks.video_rl.sources import config_of
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.recording import EpisodeBagWriter
from wm_nodes.video_model import NetworkSettings, RolloutBuffer, VideoNetwork
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder, save_video_folder
from wm_nodes.video_model.success_reader import SuccessReader, load_success_reader, save_success_reader
from wm_nodes.video_model.tokenizer_codec import codec_of_world_model
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts
from wm_nodes.world_model.position_probe import PositionProbe

STEPS, EPISODES = 12, 3
CONFIG = load_video_config("closed_loop", {"groups.history": 1, "groups.group_size": 3})


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, spec = tmp_path_factory.mktemp("closed_loop") / "bag", make_spec(height=64, width=128)
    with EpisodeBagWriter(path, spec, run_id="contexts", start_ns=1) as writer:
        for index in range(EPISODES):
            episode = make_episode(spec, index, STEPS)
            writer.write(replace(episode, ground_truth=np.full_like(episode.ground_truth, 0.1)))
    return path


@pytest.fixture(scope="module")
def contexts(bag: Path) -> Clips:
    return load_clips([bag], 1)


@pytest.fixture
def folder(contexts: Clips) -> VideoFolder:
    codec = codec_of_world_model(shipped_model("push_cube"))
    torch.manual_seed(0)
    network = VideoNetwork(NetworkSettings(codec.channels, contexts.actions.shape[2], 16, 16, 1, patch=1))
    clip = {"stride": 1, "num_conditioning": 1, "given_frames": 4, "new_frames": 4}
    return VideoFolder(codec, network, clip, {})


def sampled(folder: VideoFolder, contexts: Clips, source: type[RecordedContexts] = RecordedContexts) -> RolloutBuffer:
    torch.manual_seed(1)
    made = source(folder, contexts, CONFIG, PositionProbe(64, 128))
    request = GroupRequest((0, 2), 1 if source is RecordedTargets else 3, 0, 0, 1)
    return made.score(request, made.sample(request))


def test_of_each_group_the_best_and_another_row_are_found() -> None:
    groups = torch.tensor([0, 0, 0, 2, 2, 2])
    rewards = torch.tensor([1.0, 3, 2, torch.nan, -2, -1])
    assert [rows.tolist() for rows in best_and_worst(rewards, groups)] == [[1, 5], [0, 3]]
    for equal in (0.0, torch.nan):
        best, worst = best_and_worst(torch.full((6,), equal), groups)
        assert best.tolist() == [2, 5] and worst.tolist() == [0, 3]


def test_the_best_clip_of_each_group_trains_and_the_recording_of_its_context(
    folder: VideoFolder, contexts: Clips
) -> None:
    buffer, own = sampled(folder, contexts, BestAndRecorded), sampled(folder, contexts)
    best, worst = best_and_worst(own.reward, own.group_ids)
    assert torch.nonzero(buffer.valid)[:, 0].tolist() == sorted([*best.tolist(), *worst.tolist()])
    assert torch.equal(buffer.rollout.latents[worst], folder.codec.encode(contexts.frames[[0, 2], 1:9]))
    others = [row for row in range(6) if row not in worst]
    assert torch.equal(buffer.rollout.latents[others], own.rollout.latents[others])
    assert torch.equal(buffer.reward[best], own.reward[best]), "what it reports is what its own clips earn"
    assert torch.equal(buffer.reward[worst], own.reward[best])


def test_recorded_targets_are_the_recordings_after_the_models_own_frames(
    folder: VideoFolder, contexts: Clips
) -> None:
    buffer, groups = sampled(folder, contexts, RecordedTargets), sampled(folder, contexts)
    coded = folder.codec.encode(contexts.frames[[0, 2], 1:9])
    assert torch.equal(buffer.rollout.latents, coded) and len(buffer) == 2
    assert torch.equal(buffer.condition.frames, groups.condition.frames[::3]), "another history than that of a group"
    assert torch.equal(buffer.condition.actions, groups.condition.actions[::3])
    assert not torch.allclose(buffer.condition.frames, coded[:, :, :4], atol=0.1)


def test_flow_matching_towards_valid_clips_brings_the_model_nearer_to_them_and_equal_seeds_give_equal_bits(
    folder: VideoFolder, contexts: Clips
) -> None:
    buffer = sampled(folder, contexts, BestAndRecorded)
    settings = CONFIG.grpo.with_values(updates_per_buffer=2, learning_rate=3e-2)
    learners, start = [], weights(folder.network)
    for _ in range(2):
        network = VideoNetwork(folder.network.settings)
        network.load_state_dict(start)
        learners.append(FlowMatchingLearner(network, settings, CONFIG.rollout, seed=0, draws=4))
        again = (replace(buffer, policy_version=2 * i) for i in range(20))
        losses = [-update.objective for one in again for update in learners[-1].train(one).updates]
        assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])
    assert learners[0].version == 40
    first, second = (weights(learner.model) for learner in learners)
    assert all(torch.equal(first[name], second[name]) for name in first)
    report = learners[0].train(replace(buffer, policy_version=40))
    assert report.kept == 4 and report.updates[0].transitions == 2 * report.kept


def test_draws_are_spread_evenly(folder: VideoFolder) -> None:
    settings = CONFIG.grpo.with_values(updates_per_buffer=3)
    with pytest.raises(ValueError, match="4 draws cannot be spread over 3 updates"):
        FlowMatchingLearner(tiny_network(), settings, CONFIG.rollout, seed=0, draws=4)


def arm_config(sampler: SamplerSetup) -> VideoRlConfig:
    return config_of(sampler, ClosedLoopPlan(contexts=8, group_size=8), 0, PRESET, REWARDS)


def test_arms_cost_the_same_network_calls() -> None:
    samplers = {sampler.name: sampler for sampler in closed_loop_samplers()}
    calls = {name: calls_of_buffer(arm_config(sampler)) for name, sampler in samplers.items()}
    assert calls["CPS 0.4"] == {"history": 32, "sampling": 256, "training": 288}
    nft = calls.pop("signed FM, ODE")
    assert nft == {**calls["CPS 0.4"], "training": 384}, "the old weights are called, too"
    assert all(one == calls["CPS 0.4"] for one in calls.values()), calls
    config = arm_config(samplers["CPS 0.4"])
    assert equal_compute(config, BEST) == (8, 6), "8 clips and 8 recordings, 6 pairs each, 3 forwards a pair: 288"
    contexts, draws = equal_compute(config, RECORDINGS)
    assert contexts * (1.0 * 4 + draws * 3) == pytest.approx(576, rel=0.02)


@pytest.mark.slow
def test_the_command_trains_every_arm_and_goes_on_where_its_file_stops(
    bag: Path, folder: VideoFolder, tmp_path: Path
) -> None:
    model = save_video_folder(tmp_path / "model", folder.codec, folder.network, folder.clip, {})
    save_success_reader(model, SuccessReader(64, 128, 0.25), "push_cube", {})
    path, arms = tmp_path / "found.json", ["CPS 0.4", BEST, RECORDINGS]
    bags = ["--context-bags", str(bag), "--heldout-bags", str(bag), "--video-model", str(model)]
    size = ["--contexts", "2", "--eval-contexts", "2", "--iterations", "1"]
    more = ["--learning-rate", "3e-3", "--samplers", *arms, "--json", str(path)]
    call = ["benchmark", "closed-loop", *bags, *size, *more, "--models", str(tmp_path / "kept")]
    assert main([*call, "--seeds", "0"]) == 0
    rows = json.loads(path.read_text())["rows"]
    assert [row["sampler"] for row in rows] == arms and {row["learning_rate"] for row in rows} == {3e-3}
    for row in rows:
        first, last = row["evaluations"][0], row["evaluations"][-1]
        assert first["win"] == 0.5 and len(row["evaluations"]) == 2
        assert first["error_cm"] == pytest.approx(first["object_cm"] + first["tool_cm"], rel=1e-4)
        pairs = zip(row["before"]["error_cm"], row["after"]["error_cm"], strict=True)
        assert last["win"] == pytest.approx(np.mean([float(np.sign(old - new) + 1) / 2 for old, new in pairs]))
        assert {"tool_cm_3", "psnr_db_1"} <= last.keys()
        assert row["before"] == rows[0]["before"] and row["after"] != row["before"]
    assert len({json.dumps(row["after"]) for row in rows}) == 3, "two arms are the same training"
    for name in ("CPS_0.4_0", "best_of_n_and_recordings_0", "recordings_0"):
        kept = load_video_folder(tmp_path / "kept" / name)
        assert kept.lengths == folder.lengths and kept.manifest["base"] == load_video_folder(model).sha256
        assert kept.manifest["post_training"]["seed"] == 0 and kept.sha256 != kept.manifest["base"]
        assert load_success_reader(tmp_path / "kept" / name, "push_cube").threshold == 0.25
    assert main([*call, "--seeds", "0", "1"]) == 0
    found = json.loads(path.read_text())
    assert found["rows"][:3] == rows and len(found["rows"]) == 6
    assert {(c["sampler"], c["base"]) for c in found["comparisons"]} >= {("CPS 0.4", RECORDINGS), ("CPS 0.4", BEST)}
