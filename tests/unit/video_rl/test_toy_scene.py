"""The toy world: what is rendered where, and scores that only pixels decide."""

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from video_toys import randn

from benchmarks.video_rl.discs import training_batch
from wm_nodes.video_rl.toy_scene import (
    CHANNELS,
    COLOUR,
    DIRECTIONS,
    FRAMES,
    NUM_ACTIONS,
    RADIUS,
    SIDE,
    Scenes,
    draw_scenes,
    opacity_at,
    score,
)


def scene(action: int = 0, *, start: tuple[float, float] = (7.0, 7.0), speed: float = 1.0) -> Scenes:
    """One disc on a black background."""
    return Scenes(
        torch.zeros(1, CHANNELS, SIDE, SIDE), torch.tensor([start]), torch.tensor([speed]), torch.tensor([action])
    )


def scenes(count: int = 64) -> Scenes:
    return draw_scenes(count, seed=1, name="test")


def turned(of: Scenes, by: int) -> Tensor:
    """Videos in which the disc goes another way; actions 0 and 1, 2 and 3 are opposite."""
    return of.videos((of.action + by) % NUM_ACTIONS)


# renderer


def test_a_disc_has_its_full_colour_in_the_middle_and_a_gaussian_edge() -> None:
    video = scene().videos(torch.tensor([0]))
    assert video.shape == (1, CHANNELS, FRAMES, SIDE, SIDE)
    assert_close(video[0, :, 0, 7, 7], COLOUR)
    assert_close(video[0, :, 0, 7, 9], COLOUR * math.exp(-4 / (2 * 1.7**2)))
    assert_close(video[0, :, 0, 8, 6], COLOUR * math.exp(-2 / (2 * 1.7**2)))


@pytest.mark.parametrize(("action", "row", "column"), [(0, 7, 12), (1, 7, 2), (2, 12, 7), (3, 2, 7)])
def test_action_0_to_3_go_right_left_down_and_up_by_their_speed_each_frame(action: int, row: int, column: int) -> None:
    video = scene(action).videos(torch.tensor([action]))
    for frame, share in ((0, 0.0), (5, 1.0)):
        brightest = video[0, 0, frame].argmax()
        wanted = (round(7 + share * (row - 7)), round(7 + share * (column - 7)))
        assert (int(brightest) // SIDE, int(brightest) % SIDE) == wanted
    assert_close(
        scene(action, speed=0.9).path(torch.tensor([action]))[0, 5], torch.tensor([7.0, 7.0]) + 4.5 * DIRECTIONS[action]
    )


def test_away_from_the_disc_the_texture_stands_still() -> None:
    some = scenes(8)
    still = some.videos(some.action)
    far = (opacity_at(some.path(some.action)) < 1e-4)[:, None].expand_as(still)
    texture = some.background[:, :, None].expand_as(still)
    assert far.float().mean() > 0.3
    assert_close(still[far], texture[far], atol=1e-3, rtol=0)


def test_drawn_scenes_start_near_the_middle_at_the_right_speed_and_are_the_same_for_the_same_seed() -> None:
    many = scenes(500)
    assert (
        float((many.start - 7.5).abs().max()) <= 1 and 0.9 <= float(many.speed.min()) < float(many.speed.max()) <= 1.1
    )
    assert sorted(many.action.unique().tolist()) == [0, 1, 2, 3]
    assert 0.1 < float(many.background.std()) < 0.5
    again, other = scenes(500), draw_scenes(500, seed=1, name="test", index=1)
    assert torch.equal(many.background, again.background) and torch.equal(many.action, again.action)
    assert not torch.equal(many.background, other.background)
    assert float((many.path(many.action)).min()) > 0 and float(many.path(many.action).max()) < SIDE - 1


def test_a_condition_is_the_clean_first_frame_and_the_commanded_action_on_every_step() -> None:
    some = scenes(8)
    condition = some.condition()
    assert condition.frames.shape == (8, CHANNELS, 1, SIDE, SIDE)
    assert torch.equal(condition.frames[:, :, 0], some.videos(some.action)[:, :, 0])
    assert torch.equal(condition.frames, turned(some, 1)[:, :, :1]), "the first frame does not tell the direction"
    assert torch.equal(condition.actions.argmax(2), some.action[:, None].expand(-1, FRAMES - 1))
    assert condition.actions.sum(2).unique().tolist() == [1.0]


def test_four_in_ten_training_discs_obey_and_a_quarter_of_the_others_happens_to() -> None:
    videos, condition = training_batch(2000, seed=0, iteration=3)
    commanded = condition.actions[:, 0].argmax(1)
    alpha = (videos[:, 0] - videos[:, 1]).clamp_min(1.5)
    rows = torch.arange(SIDE, dtype=torch.float32)
    weight = alpha - 1.5
    centre = (
        torch.stack([(weight.sum(3) * rows).sum(2), (weight.sum(2) * rows).sum(2)], 2) / weight.sum((2, 3))[..., None]
    )
    went = ((centre[:, -1] - centre[:, 0]) @ DIRECTIONS.T).argmax(1)
    assert float((went == commanded).float().mean()) == pytest.approx(0.4 + 0.6 / 4, abs=0.03)
    assert torch.equal(videos, training_batch(2000, seed=0, iteration=3)[0])


# scores


def test_a_disc_that_obeys_scores_highest_in_every_respect() -> None:
    some = scenes()
    found = score(some.videos(some.action), some)
    assert float(found["task"].min()) > 0.8 and float(found["task"].mean()) > 0.9
    assert found["obeyed"].tolist() == [1.0] * 64
    assert_close(found["mass"], torch.ones(64, dtype=torch.float64), atol=0.15, rtol=0)
    assert float(found["background"].max()) < 1e-3
    assert float(found["reward"].min()) > 1.0


@pytest.mark.parametrize("by", [1, 2, 3])
def test_a_disc_that_goes_another_way_has_not_obeyed(by: int) -> None:
    some = scenes()
    right, wrong = score(some.videos(some.action), some), score(turned(some, by), some)
    assert not wrong["obeyed"].any() and bool((wrong["task"] < right["task"] - 0.2).all())
    assert bool((wrong["background"] < 2e-3).all()), "its wrong way is no error of the background"


def test_the_task_score_of_a_known_path_error_is_the_one_worked_by_hand() -> None:
    """Commanded right at speed 1, stays: errors 1 to 5, mean of exp(-error / 2)."""
    commanded = scene(0)
    still = commanded.videos(torch.tensor([0]))[:, :, :1].repeat(1, 1, FRAMES, 1, 1)
    found = score(still, commanded)
    assert float(found["task"]) == pytest.approx(sum(math.exp(-e / 2) for e in range(1, 6)) / 5, abs=1e-4)
    assert float(found["mass"]) == pytest.approx(1.0) and float(found["obeyed"]) == 0.0
    assert float(found["reward"]) == pytest.approx(float(found["task"]) + 0.3, abs=1e-4)


def test_a_disc_of_half_the_opacity_has_less_mass_and_one_that_is_gone_none() -> None:
    commanded = scene(0)
    video = commanded.videos(torch.tensor([0]))
    faint, gone = video.clone(), video.clone()
    faint[:, :, 1:] *= 0.5
    gone[:, :, 1:] = 0
    assert 0.3 < float(score(faint, commanded)["mass"]) < 0.55
    lost = score(gone, commanded)
    assert float(lost["mass"]) == 0 and float(lost["obeyed"]) == 0
    assert float(lost["task"]) == pytest.approx(math.exp(-8))


def test_a_disc_that_grows_has_more_mass_than_one_and_is_paid_for_one() -> None:
    commanded = scene(0)
    alpha = opacity_at(commanded.path(commanded.action), 1.2 * RADIUS)[:, None]
    grown = COLOUR.view(1, 2, 1, 1, 1) * alpha
    grown[:, :, 0] = commanded.videos(commanded.action)[:, :, 0]
    found = score(grown, commanded)
    assert float(found["mass"]) > 1.2
    assert float(found["reward"]) == float(found["task"] + 0.3 - 10 * found["background"])
    grown[:, :, 1:] *= 0.5
    faint = score(grown, commanded)
    assert float(faint["mass"]) < 1
    assert float(faint["reward"]) == float(faint["task"] + 0.3 * faint["mass"] - 10 * faint["background"])


def test_a_changed_background_costs_its_mean_square_and_nothing_else() -> None:
    commanded = scene(0)
    video = commanded.videos(torch.tensor([0]))
    tinted = video.clone()
    tinted[:, :, 1:] += 0.1
    found = score(tinted, commanded)
    assert float(found["background"]) == pytest.approx(0.01, rel=0.01)
    assert float(found["task"]) == pytest.approx(float(score(video, commanded)["task"]), abs=0.05)
    before = score(video, commanded)["background"]
    video[:, :, 0] += 0.1
    assert torch.equal(score(video, commanded)["background"], before), "the given frame is not scored"


def test_a_video_that_is_not_finite_gets_a_reward_that_is_not_finite_so_that_it_is_left_out() -> None:
    commanded = scene(0)
    broken = commanded.videos(torch.tensor([0]))
    broken[:, :, 3] = math.nan
    assert not math.isfinite(float(score(broken, commanded)["reward"]))


def test_every_video_is_scored_by_itself() -> None:
    some = scenes(6)
    videos = some.videos(some.action) + 0.05 * randn(6, CHANNELS, FRAMES, SIDE, SIDE)
    together = score(videos, some)["reward"]
    for i in range(6):
        one = Scenes(some.background[i : i + 1], some.start[i : i + 1], some.speed[i : i + 1], some.action[i : i + 1])
        assert float(score(videos[i : i + 1], one)["reward"]) == pytest.approx(float(together[i]), abs=1e-6)


def test_the_same_scenes_in_more_pixels_look_and_score_the_same() -> None:
    fine, coarse = draw_scenes(32, seed=1, name="test", side=24), scenes(32)
    assert torch.equal(fine.action, coarse.action)
    assert fine.videos(fine.action).shape == (32, CHANNELS, FRAMES, 24, 24)
    assert_close(fine.path(fine.action) - 23 / 2, 1.5 * (coarse.path(coarse.action) - 15 / 2), atol=1e-4, rtol=0)
    for by in (0, 1, 2, 3):
        a, b = score(turned(fine, by), fine), score(turned(coarse, by), coarse)
        assert torch.equal(a["obeyed"], b["obeyed"])
        assert_close(a["task"], b["task"], atol=0.05, rtol=0)
        assert_close(a["mass"], b["mass"], atol=0.1, rtol=0)


def test_a_picture_that_stands_still_is_most_consistent_and_obeys_nobody() -> None:
    some = scenes(16)
    still = some.videos(some.action)[:, :, :1].repeat(1, 1, FRAMES, 1, 1)
    frozen, moving = score(still, some), score(some.videos(some.action), some)
    assert frozen["consistency"].tolist() == [1.0] * 16 and not frozen["obeyed"].any()
    assert bool((moving["consistency"] < 0.6).all())
    jump = still.clone()
    jump[:, :, 3:] += 0.1
    assert_close(score(jump, some)["consistency"], torch.full((16,), math.exp(-0.01 / 5 / 0.02), dtype=torch.float64))
