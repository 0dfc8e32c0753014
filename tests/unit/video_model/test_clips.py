"""Clips, codec, scores, settings and folder of the video model."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from wm_nodes.config.load import VIDEO, ConfigError, dump_config, load_video_config, preset_names
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.seeding import torch_stream
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.video_model import NetworkSettings, RolloutSettings, VideoNetwork
from wm_nodes.video_model.clips import Clips, cut_clips
from wm_nodes.video_model.codec import PatchCodec
from wm_nodes.video_model.conditions import hashed_words
from wm_nodes.video_model.folder import load_video_folder, save_video_folder
from wm_nodes.video_rl.reference_reward import mix_rewards, score_clips
from wm_nodes.video_rl.sampling import rollout_settings
from wm_nodes.world_model.tokenizer import PROBE_NAMES


def pictures(count: int, height: int = 8, width: int = 12) -> Tensor:
    generator = torch_stream(0, "test_pictures")
    return torch.randint(0, 256, (count, height, width, 3), generator=generator, dtype=torch.uint8)


def test_a_codec_with_every_component_gives_each_pixel_back() -> None:
    codec = PatchCodec(4, 48)
    assert codec.fit(pictures(40)) == pytest.approx(1.0)
    clip = pictures(6, 16, 20).view(2, 3, 16, 20, 3)
    latents = codec.encode(clip)
    assert latents.shape == (2, 48, 3, 4, 5)
    assert torch.equal(codec.decode(latents), clip)


def test_latents_are_whitened_half_way_and_fewer_components_lose_only_what_they_say() -> None:
    frames = (pictures(60).float() * torch.linspace(0.1, 1, 12).view(1, 1, 12, 1)).to(torch.uint8)
    codec = PatchCodec(4, 16)
    kept = codec.fit(frames)
    latents = codec.encode(frames[:, None])
    deviations = latents.square().mean((0, 2, 3, 4)).sqrt() * codec.scale
    assert torch.allclose(latents.square().mean((0, 2, 3, 4)), deviations / deviations.mean(), rtol=1e-3)
    pixels = frames.float() / 255
    patches = pixels.view(60, 2, 4, 3, 4, 3).permute(0, 1, 3, 2, 4, 5).reshape(-1, 48)
    lost = (codec.decode(latents)[:, 0].float() / 255 - pixels).square().sum()
    lost = lost / (patches - patches.mean(0)).square().sum()
    assert float(lost) == pytest.approx(1 - kept, abs=0.01)


@pytest.mark.parametrize("wrong", [pictures(2, 9, 12)[None], pictures(2)[None].float()])
def test_frames_that_the_patch_does_not_divide_or_are_not_uint8_are_refused(wrong: Tensor) -> None:
    with pytest.raises(ValueError, match="frames must be uint8"):
        PatchCodec(4, 8).encode(wrong)


def test_equal_words_have_equal_vectors_and_case_does_not_matter() -> None:
    rows = hashed_words(["push the cube", "Push"], 5)
    assert rows.shape == (2, 3, 5)
    assert torch.equal(rows[0, 0], rows[1, 0]) and not rows[1, 1:].any()


def episodes(steps: int = 4) -> EpisodeArrays:
    images = np.arange(2 * (steps + 1), dtype=np.uint8).reshape(2, steps + 1, 1, 1, 1) * np.ones((8, 8, 3), np.uint8)
    actions = np.arange(2 * steps * 3, dtype=np.float32).reshape(2, steps, 3)
    truth = np.zeros((2, steps + 1, len(GROUND_TRUTH_NAMES)), np.float32)
    success = np.zeros((2, steps + 1, 1), bool)
    states = np.zeros((2, steps + 1, 3), np.float32)
    lengths = np.full(2, steps, np.int64)
    return EpisodeArrays(
        images, states, actions, truth, success, lengths, ("t",), ("push", "push"), ("a", "b"), ("t", "t")
    )


def test_a_clip_takes_every_second_frame_with_the_actions_between_in_order() -> None:
    clips = cut_clips(episodes(), 2)
    assert clips.frames[1, :, 0, 0, 0].tolist() == [5, 7, 9]
    assert clips.actions[0].tolist() == [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10, 11]]
    with pytest.raises(ValueError, match="every 3th frame"):
        cut_clips(episodes(), 3)


class TruthfulProbe:
    """Reads the positions that the test wrote into the first pixels, in cm."""

    def read(self, images: Tensor) -> np.ndarray:  # type: ignore[type-arg]
        values = images[..., 0, : len(PROBE_NAMES), 0].numpy().astype(np.float32) / 100
        return values


def recorded(positions_cm: Tensor) -> Clips:
    """Clips (N, F) whose frames hold the positions (N, F, P), and whose ground truth is the same."""
    N, F, P = positions_cm.shape
    frames = torch.full((N, F, 8, 8, 3), 7, dtype=torch.uint8)
    frames[:, :, 0, :P, 0] = positions_cm.to(torch.uint8)
    truth = np.zeros((N, F, len(GROUND_TRUTH_NAMES)), np.float32)
    for index, name in enumerate(PROBE_NAMES):
        truth[..., GROUND_TRUTH_NAMES.index(name)] = positions_cm[..., index].numpy() / 100
    return Clips(frames, torch.zeros(N, F - 1, 6), truth, ("push",) * N, "push_cube")


def test_a_clip_equal_to_its_recording_has_full_scores_and_a_shifted_object_loses_by_the_formula() -> None:
    positions = torch.tensor([10.0, 10, 10, 10, 10, 50, 50]).expand(1, 3, 7).clone()
    positions[0, 2, 0] = 20
    clips = recorded(positions)
    same = score_clips(clips.frames, clips, TruthfulProbe(), 1)  # type: ignore[arg-type]
    assert float(same.tracking) == pytest.approx(1.0) and float(same.object_cm) == pytest.approx(0.0)
    assert float(same.scenery) == 0.0 and float(same.psnr_db) == pytest.approx(80.0)
    moved = clips.frames.clone()
    moved[0, 1:, 0, 0, 0] += 3  # both generated frames: the object 3 cm off, the tool where it should be
    off = score_clips(moved, clips, TruthfulProbe(), 1)  # type: ignore[arg-type]
    assert float(off.object_cm) == pytest.approx(3.0, abs=1e-4)
    assert float(off.tracking) == pytest.approx((np.exp(-1) + 1) / 2, abs=1e-5)
    with pytest.raises(ValueError, match="their recordings"):
        score_clips(moved[:, :2], clips, TruthfulProbe(), 1)  # type: ignore[arg-type]


def test_rewards_are_mixed_by_weight_and_an_unknown_one_is_named() -> None:
    values = {"tracking": torch.tensor([1.0, 2.0]), "scenery": torch.tensor([0.1, 0.2])}
    assert torch.allclose(mix_rewards(values, {"tracking": 2.0, "scenery": -1.0}), torch.tensor([1.9, 3.8]).double())
    with pytest.raises(ValueError, match="beauty"):
        mix_rewards(values, {"beauty": 1.0})


@pytest.mark.parametrize("preset", preset_names(VIDEO))
def test_every_preset_loads_and_its_dump_loads_to_the_same(preset: str, tmp_path: Path) -> None:
    config = load_video_config(preset)
    (tmp_path / "saved.yaml").write_text(dump_config(config))
    assert load_video_config(str(tmp_path / "saved.yaml")) == config


def test_the_paper_s_preset_is_its_table_5() -> None:
    """Cosmos-Predict2.5's column; guidance off is a scale of 1."""
    config = load_video_config("paper")
    grpo, rollout, groups = config.grpo, config.rollout, config.groups
    assert (grpo.micro_batch, grpo.advantage.best_of_n, grpo.clip_low, grpo.clip_high) == (4, 8, 1e-4, 1e-4)
    assert (grpo.advantage.clip, grpo.step_fraction, grpo.cfg) == (2.5, 0.55, 1.0)
    assert (grpo.kl.beta, grpo.kl.anchor, grpo.kl.mode, grpo.updates_per_buffer) == (0.5, "buffer", "mean", 2)
    assert (grpo.learning_rate, grpo.weight_decay) == (2e-6, 0.001)
    assert (grpo.logprob_weight, grpo.mask_source, grpo.max_staleness) == ("full", "cached", 0)
    assert (rollout.sampler.arm, rollout.sampler.eta, rollout.sampler.sigma_map) == ("dyndiff", 0.6, "sin")
    assert (rollout.sampler.mask.combine, rollout.sampler.mask.budget) == ("gated", "literal")
    assert (rollout.micro_batch, rollout.cfg, groups.contexts, groups.group_size) == (2, 1.0, 16, 16)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"grpo.kl.mode": "kl9"}, "grpo.kl.mode"),
        ({"rollout.sampler.eta": 1.2}, "eta must be in"),
        ({"rollout.samplr.eta": 0.5}, "unknown setting 'rollout.samplr'"),
        ({"grpo.learning_rate": "fast"}, "grpo.learning_rate"),
        ({"rollout.noise_store": "seed", "rollout.storage_dtype": "bfloat16"}, r"noise_store: seed needs .* float32"),
        ({"rollout.sampler.mask.m_min": 0}, r"m_min.*greater than 0 \(got 0\)"),
        ({"task": "fly"}, r"task.*push_cube.*'fly'"),
        ({"evaluation.window": 2}, r"evaluation\.window.*greater than or equal to 3 \(got 2\)"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(overrides: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_video_config("smoke", overrides)


def test_the_base_preset_samples_as_the_sampler_does_by_default() -> None:
    """So no number of the sampler is set in two ways."""
    assert rollout_settings(load_video_config("base").rollout) == RolloutSettings()


def test_one_reward_can_be_weighed_without_losing_the_others() -> None:
    rewards = load_video_config("smoke").rewards
    assert load_video_config("smoke", {"rewards.object_cm": -0.1}).rewards == {**rewards, "object_cm": -0.1}
    assert load_video_config("smoke", {"rewards": {"psnr_db": 1.0}}).rewards == {"psnr_db": 1.0}


def make_folder(folder: Path) -> Path:
    network = VideoNetwork(NetworkSettings(channels=6, action_dim=3, text_dim=4, width=8, depth=1))
    return save_video_folder(folder, PatchCodec(4, 6), network, {"stride": 2, "num_conditioning": 1}, {"seed": 0})


def test_a_folder_comes_back_equal_and_a_changed_file_is_refused(tmp_path: Path) -> None:
    folder = load_video_folder(make_folder(tmp_path / "model"))
    assert folder.clip == {"stride": 2, "num_conditioning": 1} and folder.network.settings.text_dim == 4
    with pytest.raises(ModelFolderError, match=r"manifest\.json"):
        load_video_folder(tmp_path)
    data = bytearray((tmp_path / "model" / "network.safetensors").read_bytes())
    data[-1] ^= 1
    (tmp_path / "model" / "network.safetensors").write_bytes(data)
    with pytest.raises(ModelFolderError):
        load_video_folder(tmp_path / "model")
