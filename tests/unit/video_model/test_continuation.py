"""Videos made clip after clip, windows to learn that from, and videos whose actions are hidden."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from video_toys import ACTION_DIM, randn, rollout_config, tiny_network

from wm_nodes.config.load import ConfigError, load_video_config
from wm_nodes.video_model import Condition
from wm_nodes.video_model.continuation import ClipLengths, clip_condition, continue_videos
from wm_nodes.video_rl.pretraining import change_std, cut_windows, shipped_video_model

N, C, SIDE = 3, 2, 4
LENGTHS = ClipLengths(given=3, new=2)


def seeds(clip: int) -> Tensor:
    return N * clip + torch.arange(N)


def counted(frames: int) -> tuple[Tensor, Tensor]:
    """Videos and actions whose values are the numbers of their frames."""
    videos = torch.arange(float(frames)).view(1, 1, -1, 1, 1).expand(N, C, -1, SIDE, SIDE).contiguous()
    return videos, torch.arange(float(frames - 1)).view(1, -1, 1).expand(N, -1, ACTION_DIM).contiguous()


def test_a_clip_goes_on_from_the_last_frames_under_the_actions_from_there() -> None:
    videos, actions = counted(12)
    whole = Condition(videos[:, :, :1], actions, torch.zeros(N, 1, 0))
    condition = clip_condition(videos[:, :, :6], whole, LENGTHS)
    assert condition.frames[0, 0, :, 0, 0].tolist() == [3, 4, 5]
    assert condition.actions[0, :, 0].tolist() == [3, 4, 5, 6], "from frame 3 to frame 7"
    first = clip_condition(videos[:, :, :1], whole, LENGTHS)
    assert first.num_conditioning == 1 and first.actions[0, :, 0].tolist() == [0, 1]
    with pytest.raises(ValueError, match="2 frames after 11 need 12 actions, got 11"):
        clip_condition(videos[:, :, :11], whole, LENGTHS)


def test_a_video_is_continued_to_its_length_and_depends_on_what_came_before() -> None:
    network, settings, first = tiny_network(C), rollout_config(num_steps=2), randn(N, C, 1, SIDE, SIDE)
    start = Condition(first, randn(N, 5, ACTION_DIM), torch.zeros(N, 1, 0))
    whole = continue_videos(network, start, LENGTHS, 6, seeds, settings)
    assert whole.shape == (N, C, 6, SIDE, SIDE) and torch.equal(whole[:, :, :1], first)
    again = continue_videos(network, start, LENGTHS, 6, seeds, settings)
    assert torch.equal(whole, again)
    begun = continue_videos(network, start, LENGTHS, 3, seeds, settings)
    assert torch.equal(begun, whole[:, :, :3]), "later frames do not change earlier ones"
    other = continue_videos(network, replace(start, frames=first + 1), LENGTHS, 6, seeds, settings)
    assert not torch.allclose(other[:, :, -1], whole[:, :, -1])


def test_windows_keep_frames_and_actions_together_and_reach_every_length() -> None:
    videos, actions = counted(12)
    settings = load_video_config("closed_loop").model.training
    lengths = set()
    for iteration in range(60):
        condition = Condition(videos[:, :, :1], actions, torch.zeros(N, 1, 0))
        cut, given = cut_windows(videos, condition, settings, np.random.default_rng(iteration))
        lengths.add((given.num_conditioning, cut.shape[2] - given.num_conditioning))
        assert torch.equal(cut[:, :, : given.num_conditioning], given.frames)
        assert torch.equal(given.actions[..., 0], cut[:, 0, :-1, 0, 0]), "action f leads from frame f"
        assert bool((cut[:, 0].diff(dim=1) == 1).all())
    assert lengths == {(given, new) for given in range(1, 5) for new in range(1, 5)}
    rngs = map(np.random.default_rng, range(50))
    short = [cut_windows(videos[:, :, :7], condition, settings, rng)[0].shape[2] for rng in rngs]
    assert max(short) == 7, "no longer than what there is"
    with pytest.raises(ValueError, match="videos of 4 frames have none after 4 given ones"):
        cut_windows(videos[:, :, :4], condition, settings, np.random.default_rng(0))


def test_the_scale_of_a_change_is_that_of_the_frames_a_clip_makes() -> None:
    videos, _ = counted(12)
    assert change_std(videos, 1, new_frames=3) == pytest.approx(np.sqrt((1 + 4 + 9) / 3))


def test_hidden_actions_are_no_zero_actions_and_no_dropped_condition() -> None:
    network = tiny_network(C, text_dim=3)
    x, t = randn(N, C, 4, SIDE, SIDE), torch.full((N,), 0.5, dtype=torch.float64)
    condition = Condition(randn(N, C, 1, SIDE, SIDE), torch.zeros(N, 3, ACTION_DIM), randn(N, 1, 3))
    hidden = condition.without_actions()
    seen = {
        "zero actions": network(x, t, condition), "hidden": network(x, t, hidden),
        "dropped": network(x, t, condition, torch.ones(N, dtype=torch.bool)),
    }
    by_row = network(x, t, condition, torch.tensor([[True, False]] * N))
    assert torch.equal(by_row, seen["hidden"])
    for one, other in (("zero actions", "hidden"), ("hidden", "dropped")):
        assert not torch.allclose(seen[one], seen[other]), f"{one} and {other}"


def test_the_shipped_video_models_serve_their_presets() -> None:
    for preset in ("recommended", "outcome", "closed_loop"):
        config = load_video_config(preset)
        shipped = shipped_video_model(config)
        assert shipped is not None and shipped.manifest["model"] == config.model.model_dump()
        assert (shipped.lengths is not None) == (preset == "closed_loop")


@pytest.mark.parametrize(
    ("change", "said"),
    [({"groups.hide_actions": True}, "trained without actions"), ({"groups.history": 1}, "go on from its own frames"),
     ({"model.training.given_frames": 2}, "go together")],
)
def test_what_a_model_never_learned_is_not_asked_of_it(change: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_video_config("base", change)
