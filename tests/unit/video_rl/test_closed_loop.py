"""Continuations of a video model's own frames: what a group shares, what it is scored against, and its head-room."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from video_toys import ACTION_DIM, PixelCodec, randn, tiny_network, toy_clips

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl import validation
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.horizons import Headroom, horizon_scores, measure_headroom
from wm_nodes.video_rl.reference_reward import PICTURE_SCORES, score_pictures
from wm_nodes.video_rl.reward_hacking import WATCHED
from wm_nodes.video_rl.sampling import (
    GroupRequest,
    RecordedContexts,
)
from wm_nodes.video_rl.train import post_train, sample_buffers
from wm_nodes.video_rl.validation import context_scores, validation_scores
from wm_nodes.world_model.position_probe import PositionProbe

GIVEN, NEW, FRAMES = 3, 2, 9
CONFIG = load_video_config("smoke", {
    "model.stride": 1, "model.training.given_frames": GIVEN, "model.training.new_frames": NEW, "groups.history": 3,
    "rewards": {"psnr_db": 1.0}, "groups.shared_noise": True,
})


def recorded(frames: int = FRAMES) -> Clips:
    """Two contexts whose frame f of context i is of grey value 10 i + f."""
    values = torch.arange(frames).view(1, -1) + 10 * torch.arange(2).view(-1, 1)
    pictures = values.view(2, frames, 1, 1, 1).expand(2, frames, 8, 12, 3).to(torch.uint8)
    actions = randn(2, frames - 1, ACTION_DIM)
    truth = np.full((2, frames, len(GROUND_TRUTH_NAMES)), 0.1, np.float32)
    return toy_clips(pictures, actions, truth, ("push", "pull"))


def make_folder(given: int = GIVEN, seed: int = 0) -> VideoFolder:
    codec: Any = PixelCodec()
    clip = {"stride": 1, "num_conditioning": 1, "given_frames": given, "new_frames": NEW} if given else {
        "stride": 1, "num_conditioning": 1
    }
    network = tiny_network(codec.channels)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * randn(*parameter.shape, seed=seed))
    return VideoFolder(codec, network, clip, {})


def make_source(config: VideoRlConfig = CONFIG, folder: VideoFolder | None = None) -> RecordedContexts:
    return RecordedContexts(folder or make_folder(), recorded(), config, PositionProbe(8, 12))


def test_a_group_goes_on_from_one_self_made_history_under_the_recorded_actions() -> None:
    source = make_source()
    request = GroupRequest((1, 0), 3, 5, 0, history=2)
    buffer = source.sample(request)
    assert buffer.rollout.latents.shape == (6, 48, GIVEN + NEW, 2, 3)
    given = buffer.condition.frames.view(2, 3, 48, GIVEN, 2, 3)
    assert torch.equal(given, given[:, :1].expand_as(given)), "not one history for a group"
    assert torch.equal(buffer.rollout.latents[:, :, :GIVEN], buffer.condition.frames)
    assert not torch.equal(buffer.rollout.latents[0], buffer.rollout.latents[1]), "a group of one clip"
    codec, contexts = source.folder.codec, source.contexts
    assert not torch.allclose(given[0, 0], codec.encode(contexts.frames)[1, :, 2:5]), "recorded frames, not its own"
    first, clip = 2, GIVEN + NEW  # after frames 0 to 4 those are 2, 3, 4, and 5, 6 are new
    assert torch.equal(buffer.condition.actions[0], contexts.actions[1, first : first + clip - 1])
    references = source.references(request)
    assert references.frames[::3, :, 0, 0, 0].tolist() == [[12, 13, 14, 15, 16], [2, 3, 4, 5, 6]]
    assert references.actions.shape == (6, clip - 1, ACTION_DIM) and references.ground_truth.shape[1] == clip


def test_the_history_is_of_the_weights_that_sample_and_equal_requests_give_equal_bytes() -> None:
    request = GroupRequest((0, 1), 2, 1, 0, history=1)
    first, again, other = (make_source(folder=make_folder(seed=seed)).sample(request) for seed in (0, 0, 1))
    assert first.to_bytes() == again.to_bytes()
    assert not torch.equal(first.condition.frames, other.condition.frames)
    later = make_source().sample(replace(request, iteration=2))
    assert not torch.equal(first.condition.frames, later.condition.frames), "each iteration has a history of its own"


@pytest.mark.parametrize(("history", "first", "given"), [(0, 0, 1), (1, 0, 3), (2, 2, 3), (3, 4, 3)])
def test_a_clip_begins_with_as_many_frames_as_there_are(history: int, first: int, given: int) -> None:
    source, request = make_source(), GroupRequest((0,), 1, 0, 0, history=history)
    buffer = source.sample(request)
    assert buffer.condition.num_conditioning == given and buffer.rollout.latents.shape[2] == given + NEW
    assert source.references(request).frames[0, 0, 0, 0, 0] == first


def test_how_many_clips_come_before_is_drawn_for_each_iteration_from_the_seed_alone() -> None:
    source = make_source()
    drawn = [source.request(iteration, 0).history for iteration in range(40)]
    assert set(drawn) == {0, 1, 2, 3} and drawn == [make_source().request(i, 1).history for i in range(40)]
    for iteration, history in enumerate(drawn[:12]):
        request = source.request(iteration, 0)
        assert history is not None
        first, given = source.place(history)
        assert (first, given) == ((2 * history + 1 - GIVEN, GIVEN) if history else (0, 1))
        assert source.references(request).frames[0, 0, 0, 0, 0] == first + 10 * request.contexts[0]
    plain = make_source(CONFIG.with_values(groups=CONFIG.groups.with_values(history=0))).request(0, 0)
    assert plain.history is None and source.place(None) == (0, 1)


def test_a_continuation_is_scored_on_its_new_frames_alone() -> None:
    source, request = make_source(), GroupRequest((0, 1), 2, 0, 0, history=1)
    buffer = source.sample(request)
    frames = source.folder.codec.decode(buffer.rollout.latents)[:, GIVEN:].float()
    wanted = source.references(request).frames[:, GIVEN:].float()
    psnr = -10 * ((frames - wanted) / 255).square().mean((1, 2, 3, 4)).log10()
    torch.testing.assert_close(source.score(request, buffer).rewards["total"], psnr.double(), rtol=1e-5, atol=1e-5)


def test_a_group_is_trained_and_evaluated_by_closeness_where_no_recording_has_simulator_state() -> None:
    config = CONFIG.with_values(rewards={"closeness": 1.0})
    blind = recorded()
    blind.ground_truth[:] = np.nan
    folder, probe = make_folder(), PositionProbe(8, 12)
    source = RecordedContexts(folder, blind, config, probe)
    learner = GrpoLearner(folder.network, config.grpo, config.rollout, seed=0)
    (buffer, report), = post_train(learner, sample_buffers(source, learner, 1))
    request = source.request(0, 0)
    frames, given = folder.codec.decode(buffer.rollout.latents), buffer.condition.num_conditioning
    wanted = score_pictures(frames, source.references(request), folder.codec, given)
    assert torch.equal(buffer.rewards["total"], wanted["closeness"]) and buffer.valid.all()
    assert buffer.rewards["tracking"].isnan().all() and buffer.rewards["outcome"].isnan().all()
    assert report.reward_mean == pytest.approx(float(wanted["closeness"].mean())) and learner.version > 0
    heldout = context_scores(folder, blind, probe, config)
    assert heldout["closeness"].isfinite().all() and set(PICTURE_SCORES) <= set(WATCHED)
    for one in measure_headroom(folder, blind, config, probe):
        assert one.codec > one.reward and one.gain[0] > 0


def test_scenery_pays_where_the_frames_of_each_clip_have_some_and_held_out_clips_without_are_not_refused() -> None:
    """The camera moves by 3 grey values a frame, 12 within five of them."""
    slow = replace(recorded(), frames=3 * recorded().frames)
    config = CONFIG.with_values(rewards={"scenery": -1.0})
    whole = config.with_values(groups=config.groups.with_values(history=0))
    folder, probe = make_folder(), PositionProbe(8, 12)
    assert make_source(config).config == RecordedContexts(folder, slow, config, probe).config
    with pytest.raises(ValueError, match="no pixel of recording 0 does"):
        RecordedContexts(folder, slow, whole, probe)
    fast = replace(slow, frames=2 * slow.frames)
    with pytest.raises(ValueError, match="no pixel of recording 0 does"):
        RecordedContexts(folder, fast, config, probe)
    assert context_scores(folder, fast, probe, config)["scenery"].isnan().all()


def test_the_held_out_reward_is_known_where_what_is_not_scored_has_no_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "load_clips", lambda *_: recorded())
    monkeypatch.setattr(validation, "load_probe", lambda *_: PositionProbe(8, 12))
    config = CONFIG.with_values(rewards={"psnr_db": 0.5, "agent": 0.0})
    found = validation_scores(make_folder(), [], Path(), config)()
    assert found["reward"] == pytest.approx(0.5 * found["psnr_db"])


def test_settings_that_a_model_or_its_recordings_cannot_have_are_refused() -> None:
    with pytest.raises(ValueError, match="whole episodes"):
        make_source(folder=make_folder(given=0))
    with pytest.raises(ValueError, match="3 clips and one more have 9 frames, the recordings 8"):
        RecordedContexts(make_folder(), recorded(8), CONFIG)
    with pytest.raises(ValueError, match="a judge sees whole episodes"):
        load_video_config("closed_loop", {"rewards.agent": 1.0})


def test_a_group_of_equal_clips_has_no_head_room_and_one_of_different_clips_what_its_best_is_better_by() -> None:
    silent = CONFIG.with_values(rollout=CONFIG.rollout.with_values(
        sampler=CONFIG.rollout.sampler.with_values(eta=0.0)
    ))
    folder, probe = make_folder(), PositionProbe(8, 12)
    found = measure_headroom(folder, recorded(), silent, probe)
    assert [one.clips for one in found] == [1, 2, 3, 4]
    for one in found:
        assert one.gain == pytest.approx((0, 0, 0), abs=1e-9)
        assert one.share == pytest.approx(0, abs=1e-6) and one.codec > one.reward
    source = make_source()
    for one in measure_headroom(folder, recorded(), CONFIG, probe):
        request = GroupRequest((0, 1), 3, one.clips - 1, 0, one.clips - 1)
        rewards = source.score(request, source.sample(request)).rewards["total"].view(2, 3)
        assert one.gain[0] == pytest.approx(float((rewards.amax(1) - rewards.mean(1)).mean())) and one.gain[0] > 0
        assert one.best - one.reward == pytest.approx(one.gain[0])
    whole = measure_headroom(make_folder(given=0), recorded(), CONFIG, probe)
    assert [one.clips for one in whole] == [1]


def test_a_gain_is_weighed_against_what_is_missing_to_the_codec() -> None:
    one = Headroom(2, 0.5, 0.52, (0.02, 0.01, 0.03), 0.7)
    assert one.share == pytest.approx(0.15) and replace(one, codec=0.5).share == 0


def test_each_clip_of_a_rollout_is_scored_by_itself() -> None:
    clips, folder, probe = recorded(), make_folder(), PositionProbe(8, 12)
    frames: Tensor = clips.frames.clone()
    frames[:, 4] += 50  # the last frame of the second clip: frames 3 and 4
    found = {name: float(values.mean()) for name, values in horizon_scores(frames, clips, probe, folder).items()}
    assert [found[f"psnr_db_{clip}"] for clip in (1, 3, 4)] == pytest.approx([80.0] * 3)
    assert found["psnr_db_2"] == pytest.approx(-10 * np.log10((50 / 255) ** 2 / 2), abs=1e-3)
    assert {f"{name}_{clip}" for name in ("tool_cm", "object_cm", "psnr_db") for clip in (1, 2, 3, 4)} == found.keys()


def test_of_a_model_that_is_given_no_frame_the_first_one_is_scored_too() -> None:
    clips, folder = recorded(), replace(make_folder(given=0), clip={"stride": 1, "num_conditioning": 0})
    frames = clips.frames.clone()
    frames[:, 0] += 50
    found = horizon_scores(frames, clips, PositionProbe(8, 12), folder)
    assert float(found["psnr_db_1"].mean()) == pytest.approx(-10 * np.log10((50 / 255) ** 2 / FRAMES), abs=1e-3)
