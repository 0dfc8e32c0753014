"""Clips, scores, settings and folder of the video model."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from recording_samples import make_episode, make_spec
from torch import Tensor
from video_toys import small_codec, toy_clips

from wm_nodes.config.load import VIDEO, ConfigError, dump_config, load_video_config, preset_names, reward_overrides
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.seeding import torch_stream
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.recording import EpisodeBagWriter, read_episodes
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.video_model import NetworkSettings, VideoNetwork
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.conditions import hashed_words
from wm_nodes.video_model.folder import load_video_folder, save_video_folder
from wm_nodes.video_rl.reference_reward import PICTURE_SCORES, mix_rewards, score_clips, score_pictures
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts
from wm_nodes.world_model.positions import position_names, probe_targets
from wm_nodes.world_model.tokenizer import NUM_POSITIONS


def test_equal_words_have_equal_vectors_and_case_does_not_matter() -> None:
    rows = hashed_words(["push the cube", "Push"], 5)
    assert rows.shape == (2, 3, 5)
    assert torch.equal(rows[0, 0], rows[1, 0]) and not rows[1, 1:].any()


class TruthfulProbe:
    """Reads the positions that the test wrote into the first pixels, in cm."""

    def read(self, images: Tensor) -> np.ndarray:  # type: ignore[type-arg]
        values = images[..., 0, : NUM_POSITIONS, 0].numpy().astype(np.float32) / 100
        return values


def recorded(positions_cm: Tensor) -> Clips:
    """Clips (N, F) whose frames hold the positions (N, F, P), and whose ground truth is the same."""
    N, F, P = positions_cm.shape
    frames = torch.full((N, F, 8, 8, 3), 7, dtype=torch.uint8)
    frames[:, :, 0, :P, 0] = positions_cm.to(torch.uint8)
    truth = np.zeros((N, F, len(GROUND_TRUTH_NAMES)), np.float32)
    for index, name in enumerate(position_names("push_cube")):
        truth[..., GROUND_TRUTH_NAMES.index(name.replace("object", "cube"))] = positions_cm[..., index].numpy() / 100
    return toy_clips(frames, torch.zeros(N, F - 1, 6), truth)


def test_a_clip_equal_to_its_recording_has_full_scores_and_a_shifted_object_loses_by_the_formula() -> None:
    positions = torch.tensor([10.0, 10, 10, 10, 10, 50, 50]).expand(1, 3, 7).clone()
    positions[0, 2, 0] = 20
    clips = recorded(positions)
    same = score_clips(clips.frames, clips, TruthfulProbe(), 1)  # type: ignore[arg-type]
    assert float(same["tracking"]) == pytest.approx(1.0) and float(same["object_cm"]) == pytest.approx(0.0)
    assert float(same["scenery"]) == 0.0 and float(same["psnr_db"]) == pytest.approx(80.0)
    moved = clips.frames.clone()
    moved[0, 1:, 0, 0, 0] += 3  # both generated frames: the object 3 cm off, the tool where it should be
    off = score_clips(moved, clips, TruthfulProbe(), 1)  # type: ignore[arg-type]
    assert float(off["object_cm"]) == pytest.approx(3.0, abs=1e-4)
    assert float(off["tracking"]) == pytest.approx((np.exp(-1) + 1) / 2, abs=1e-5)
    with pytest.raises(ValueError, match="their recordings"):
        score_clips(moved[:, :2], clips, TruthfulProbe(), 1)  # type: ignore[arg-type]


def test_the_goal_above_an_object_is_where_the_clip_shows_it_and_not_where_the_recording_left_it() -> None:
    """The recorded cube is pushed by 20 cm; in the clip it stays, and the tool gets to 8 cm above its middle."""
    positions = torch.tensor([10.0, 10, 40, 40, 10, 50, 50]).expand(1, 3, 7).clone()
    positions[0, 2, 0] = 30
    clips = replace(recorded(positions), task="reach")
    made = clips.frames.clone()
    made[0, 2, 0, :5, 0] = torch.tensor([10, 10, 10, 10, 10])
    found = score_clips(made, clips, TruthfulProbe(), 1)  # type: ignore[arg-type]
    assert (float(found["success"]), float(found["outcome"])) == (1.0, 1.0)
    made[0, 2, 0, 0, 0] = 14  # the cube 4 cm off, of which 2 cm are tolerated
    off = score_clips(made, clips, TruthfulProbe(), 1)  # type: ignore[arg-type]
    assert float(off["success"]) == 0.0 and float(off["outcome"]) == pytest.approx(np.exp(-0.02 / 0.05), abs=1e-5)


def test_scenery_is_unknown_where_nothing_stands_still_and_is_no_reward_there() -> None:
    """The second of two recordings is of a camera that moves."""
    frames = flat_clips(100, 100)
    frames[1, 1:] += 50
    clips = pictures_of(frames)
    found = score_clips(frames, clips, TruthfulProbe(), 1)["scenery"]  # type: ignore[arg-type]
    assert float(found[0]) == 0.0 and found[1].isnan()
    folder: Any = SimpleNamespace(codec=small_codec(), clip={"num_conditioning": 1})
    probe: Any = TruthfulProbe()
    paid, unpaid = (load_video_config("base", {"rewards.scenery": weight}) for weight in (-5.0, 0.0))
    RecordedContexts(folder, clips, unpaid, probe)
    RecordedContexts(folder, clips.first(1), paid, probe)
    with pytest.raises(ValueError, match=r"no pixel of recording 1 does; set rewards\.scenery 0"):
        RecordedContexts(folder, clips, paid, probe)


class FirstPixel:
    """The codec whose one latent is the red value of the first pixel, of 255."""

    def encode(self, frames: Tensor) -> Tensor:
        return frames[..., :1, :1, 0].unsqueeze(1).float() / 255


def flat_clips(*levels: int, frames: int = 3) -> Tensor:
    return torch.stack([torch.full((frames, 16, 16, 3), level, dtype=torch.uint8) for level in levels])


def pictures_of(frames: Tensor) -> Clips:
    """Recordings (N, F) that show these frames and have no simulator state."""
    N, F = frames.shape[:2]
    truth = np.full((N, F, len(GROUND_TRUTH_NAMES)), np.nan, np.float32)
    return toy_clips(frames, torch.zeros(N, F - 1, 6), truth)


def test_closeness_is_the_mean_of_psnr_ssim_and_the_perceptual_score_of_the_generated_frames() -> None:
    """White against grey 51: an error of 0.8 in every pixel and in the latent."""
    clips, codec = flat_clips(255), FirstPixel()
    same = score_pictures(clips, pictures_of(clips), codec, 1)  # type: ignore[arg-type]
    assert tuple(same) == PICTURE_SCORES and [float(same[name]) for name in PICTURE_SCORES] == [1.0, 1.0, 1.0]
    other = flat_clips(51)
    other[:, 0] = 255  # the given frame
    off = score_pictures(clips, pictures_of(other), codec, 1)  # type: ignore[arg-type]
    assert float(off["perceptual"]) == pytest.approx(np.exp(-0.8)) and off["closeness"].dtype == torch.float64
    assert float(off["ssim"]) == pytest.approx(0.4001 / 1.0401, abs=2e-4)
    wanted = (-20 * np.log10(0.8) / 40 + float(off["ssim"]) + np.exp(-0.8)) / 3
    assert float(off["closeness"]) == pytest.approx(wanted, abs=1e-6)
    half = other.clone()
    half[:, 1] = 255  # one of the two generated frames as recorded
    both = score_pictures(clips, pictures_of(half), codec, 1)  # type: ignore[arg-type]
    assert float(both["closeness"]) == pytest.approx((1 + wanted) / 2, abs=1e-6)
    with pytest.raises(ValueError, match="their recordings"):
        score_pictures(clips[:, :2], pictures_of(clips), codec, 1)  # type: ignore[arg-type]


def test_a_clip_with_less_noise_is_closer_and_no_picture_leaves_the_bounds() -> None:
    picture = torch.randint(0, 256, (16, 16, 3), generator=torch_stream(0, "test_pictures"), dtype=torch.uint8)
    codec, clean = small_codec(), picture.expand(5, 3, 16, 16, 3).clone()
    noise = torch.randint(-1, 2, clean.shape, generator=torch_stream(0, "test_noise"))
    shown = (clean.int() + noise * torch.tensor([0, 10, 30, 90, 255]).view(5, 1, 1, 1, 1)).clamp(0, 255)
    found = score_pictures(shown.to(torch.uint8), pictures_of(clean), codec, 1)
    for name in PICTURE_SCORES:
        assert found[name].tolist() == sorted(found[name].tolist(), reverse=True), name
    inverse = score_pictures(255 - clean, pictures_of(clean), codec, 1)["closeness"]
    assert (found["closeness"][0], bool((inverse > -1 / 3).all())) == (1.0, True)


def test_without_simulator_state_pictures_are_scored_and_all_else_is_unknown(tmp_path: Path) -> None:
    spec = make_spec(ground_truth_names=())
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="pictures", start_ns=1) as bag:
        bag.write(make_episode(spec, 0, 4))
    clips = load_clips([tmp_path / "bag"], 2)
    assert clips.ground_truth.shape == (1, 3, len(GROUND_TRUTH_NAMES)) and np.isnan(clips.ground_truth).all()
    weights = {"closeness": 0.5, "ssim": 0.5, "tracking": 0.0}
    folder: Any = SimpleNamespace(codec=small_codec(), clip={"num_conditioning": 1})

    def scores(**rewards: float) -> dict[str, Tensor]:
        blind: Any = object()
        source = RecordedContexts(folder, clips, load_video_config("base", {"rewards": rewards}), blind)
        return source.scores(GroupRequest((0,), 1, 0, 0), clips.frames)

    found = scores(**weights)
    known = {"psnr_db", *PICTURE_SCORES}  # frames of noise have no scenery
    assert {name for name, values in found.items() if torch.isfinite(values).all()} == known
    assert mix_rewards(found, weights).tolist() == [1.0]
    assert found.keys() - scores(tracking=1.0).keys() == set(PICTURE_SCORES)


def written(folder: Path, *lengths: int, **changes: Any) -> Path:
    """A bag of episodes of so many steps; changes: of the last one."""
    spec = make_spec()
    with EpisodeBagWriter(folder / "bag", spec, run_id="lengths", start_ns=1) as bag:
        for index, steps in enumerate(lengths):
            bag.write(make_episode(spec, index, steps, **(changes if index == len(lengths) - 1 else {})))
    return folder / "bag"


def test_episodes_of_unequal_length_are_refused_or_cut_and_no_clip_shows_a_frame_that_was_not_recorded(
    tmp_path: Path,
) -> None:
    bag = written(tmp_path, 8, 1, 2, 5)
    with pytest.raises(ValueError, match=r"episodes of 1 to 8 steps are no clips of one length; set clip_steps"):
        load_clips([bag], 1)
    with pytest.raises(ValueError, match="no episode has 10 steps, the longest 8"):
        load_clips([bag], 2, 10)
    with pytest.raises(ValueError, match="episodes of 4 steps cannot be cut at every 3th frame"):
        load_clips([bag], 3, 4)
    clips, recorded = load_clips([bag], 2, 4), list(read_episodes(bag))
    assert (len(clips), clips.seeds) == (2, (1000, 1003)) and clips.actions.shape[1:] == (2, 6)
    for row, episode in enumerate((recorded[0], recorded[3])):
        np.testing.assert_array_equal(clips.frames[row], episode.images[:5:2])
        np.testing.assert_array_equal(clips.actions[row].flatten(), episode.actions[:4].flatten())
        np.testing.assert_array_equal(clips.ground_truth[row], episode.ground_truth[:5:2])


def test_episodes_that_were_recorded_for_another_task_of_the_scene_are_paid_and_told_as_the_one_that_is_asked_for(
    tmp_path: Path,
) -> None:
    """Those of `reach` are recorded for push_cube: the cube is in the goal, and the tool beside it."""
    truth = np.zeros((5, len(GROUND_TRUTH_NAMES)), np.float32)
    truth[:, GROUND_TRUTH_NAMES.index("tool_x")] = 0.5
    bag = written(tmp_path, 4, ground_truth=truth)
    pushed, reached = (load_clips([bag], 2, 0, task) for task in ("", "reach"))
    assert (pushed.task, pushed.instructions) == ("push_cube", ("push the cube to the goal",))
    assert (reached.task, reached.instructions) == ("reach", ("move the gripper above the blue cube",))
    pictures, done = flat_clips(0), list[float]()
    for clips in (pushed, reached):
        shown = replace(clips, frames=pictures)
        probe: Any = SimpleNamespace(read=lambda images, shown=shown: probe_targets(
            shown.ground_truth[:, 1:], shown.task
        ))
        done.append(float(score_clips(pictures, shown, probe, 1)["success"]))
    assert done == [1.0, 0.0]
    with pytest.raises(ValueError, match="recorded for the task push_cube, whose scene does not show pull_cube"):
        load_clips([bag], 2, 0, "pull_cube")
    mixed = written(tmp_path / "mixed", 4, 4, task="reach")
    with pytest.raises(ValueError, match="episodes of push_cube, reach are no clips of one task"):
        load_clips([mixed], 2)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_simulator_state_that_is_no_number_in_some_frames_is_refused_by_its_place(
    value: float, tmp_path: Path
) -> None:
    truth = make_episode(make_spec(), 1, 4).ground_truth
    truth[3, 2] = value
    with pytest.raises(ValueError, match=rf"bag: episode 1: ground_truth\[3, 2\] is {value}; record the episode again"):
        load_clips([written(tmp_path, 4, 4, ground_truth=truth)], 2)
    truth[:, 2] = np.nan
    clips = load_clips([written(tmp_path / "unknown", 4, 4, ground_truth=truth)], 2)
    assert np.isnan(clips.ground_truth[1, :, 2]).all(), "a value that nobody knows is no fault"


def test_an_action_that_is_no_number_is_refused_by_its_place() -> None:
    episode = make_episode(make_spec(), 7, 4)
    episode.actions[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"episode 7 .* has nan in actions\[2, 1\]; leave it out, or record it again"):
        stack_episodes([episode], ["push_cube"])


def test_rewards_are_mixed_by_weight_and_an_unknown_one_is_named() -> None:
    values = {"tracking": torch.tensor([1.0, 2.0]), "scenery": torch.tensor([0.1, 0.2])}
    assert torch.allclose(mix_rewards(values, {"tracking": 2.0, "scenery": -1.0}), torch.tensor([1.9, 3.8]).double())
    with pytest.raises(ValueError, match="beauty"):
        mix_rewards(values, {"beauty": 1.0})
    unscored = {"tracking": 0.5, "scenery": 0.5, "beauty": 0.0}
    assert torch.allclose(mix_rewards(values, unscored), torch.tensor([0.55, 1.1]).double())
    with pytest.raises(ValueError, match="weigh some of"):
        mix_rewards(values, {"tracking": 0.0})


@pytest.mark.parametrize("preset", preset_names(VIDEO))
def test_every_preset_loads_and_its_dump_loads_to_the_same(preset: str, tmp_path: Path) -> None:
    config = load_video_config(preset)
    (tmp_path / "saved.yaml").write_text(dump_config(config))
    assert load_video_config(str(tmp_path / "saved.yaml")) == config


def test_the_paper_s_preset_is_its_table_5() -> None:
    """Cosmos-Predict2.5's column; guidance off is a scale of 1."""
    config = load_video_config("paper")
    grpo, rollout, groups = config.grpo, config.rollout, config.groups
    assert (grpo.micro_batch, grpo.advantage.best_of_n, grpo.clip) == (4, 8, 1e-4)
    assert (grpo.advantage.clip, grpo.step_fraction) == (2.5, 0.55)
    assert (grpo.kl.beta, grpo.kl.anchor, grpo.kl.mode, grpo.updates_per_buffer) == (0.5, "buffer", "mean", 2)
    assert (grpo.learning_rate, grpo.weight_decay) == (2e-6, 0.001)
    assert grpo.logprob_weight == "full"
    assert (rollout.sampler.arm, rollout.sampler.eta) == ("dyndiff", 0.6)
    assert (rollout.sampler.mask.combine, rollout.sampler.mask.budget) == ("gated", "literal")
    assert (rollout.micro_batch, rollout.cfg, groups.contexts, groups.group_size) == (2, 1.0, 16, 16)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"grpo.kl.mode": "kl9"}, "grpo.kl.mode"),
        ({"rollout.sampler.eta": 1.2}, "eta must be in"),
        ({"rollout.samplr.eta": 0.5}, "unknown setting 'rollout.samplr'"),
        ({"grpo.learning_rate": "fast"}, "grpo.learning_rate"),
        ({"rollout.sampler.mask.m_min": 0}, r"m_min.*greater than 0 \(got 0\)"),
        (
            {"rollout.sampler.arm": "ode", "grpo.objective": "nft", "grpo.kl.beta": 0, "groups.shared_noise": True},
            r"rollout\.sampler\.arm ode.*the same; set groups\.shared_noise false",
        ),
        (
            {"rollout.sampler.eta": 0, "grpo.objective": "nft", "grpo.kl.beta": 0, "groups.shared_noise": True},
            r"eta 0.*the same; set groups\.shared_noise false",
        ),
        ({"task": "fly"}, r"task.*push_cube.*'fly'"),
        ({"evaluation.window": 2}, r"evaluation\.window.*greater than or equal to 3 \(got 2\)"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(overrides: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_video_config("smoke", overrides)


def test_one_reward_can_be_weighed_without_losing_the_others() -> None:
    rewards = load_video_config("smoke").rewards
    assert load_video_config("smoke", {"rewards.object_cm": -0.1}).rewards == {**rewards, "object_cm": -0.1}
    assert load_video_config("smoke", {"rewards": {"psnr_db": 1.0}}).rewards == {"psnr_db": 1.0}


def test_the_rewards_that_the_command_line_names_replace_those_of_the_preset() -> None:
    named = {name: load_video_config("closed_loop", reward_overrides(name)).rewards for name in (None, "closeness")}
    assert named == {None: {"tracking": 1.0}, "closeness": {"closeness": 1.0}}
    assert load_video_config("outcome", reward_overrides("reference")).rewards == load_video_config("base").rewards


def make_folder(folder: Path) -> Path:
    network = VideoNetwork(NetworkSettings(channels=6, action_dim=3, text_dim=4, width=8, depth=1))
    return save_video_folder(folder, small_codec(), network, {"stride": 2, "num_conditioning": 1}, {"seed": 0})


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
