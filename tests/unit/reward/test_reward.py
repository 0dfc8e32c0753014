"""Rewards against numbers worked by hand; missing is missing. RS-5, RS-7, RS-8."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RewardConfig
from wm_nodes.core.types import UInt8Array
from wm_nodes.reward import (
    SUCCESS_NO,
    SUCCESS_UNKNOWN,
    SUCCESS_YES,
    Distance,
    EncoderDistance,
    EndogenousReward,
    RewardInput,
    RuleReward,
)
from wm_nodes.reward.base import version_of

SIDE_PX = 8
RANDOM = np.random.default_rng(0)
pixel_l1 = EncoderDistance(lambda images: images.float(), scale=255.0)


def grey(*levels: int) -> UInt8Array:
    return np.stack([np.full((SIDE_PX, SIDE_PX, 3), level, np.uint8) for level in levels])


def step(before: UInt8Array, after: UInt8Array, probability: float = 0.0, **more: Any) -> RewardInput:
    count = len(before)
    return RewardInput(
        images=before, next_images=after, success_probability=np.full(count, probability, np.float32),
        valid=np.ones(count, bool), uncertainty=np.zeros(count, np.float32), **more,
    )


def settings(**changes: Any) -> RewardConfig:
    values = {"mode": "delta", "dense_weight": 0.5, "sparse_weight": 2.0, "success_threshold": 0.7, "dense_clip": 0.2,
              "uncertainty_limit": 0.0, **changes}
    return load_config("base").reward.model_copy(update=values)


def test_delta_pays_for_coming_closer_charges_for_going_away_and_not_for_staying() -> None:
    judged = EndogenousReward(settings(), pixel_l1).evaluate(
        step(grey(100, 100, 100), grey(125, 75, 100), goals=grey(200, 200, 200))
    )
    np.testing.assert_allclose(judged.dense, [0.5 * 25 / 255, -0.5 * 25 / 255, 0.0], atol=1e-6)
    np.testing.assert_array_equal(judged.total, judged.dense + judged.sparse)
    assert judged.valid.all() and judged.invalid_reason == ""
    assert judged.weights == {"dense": 0.5, "sparse": 2.0}


def test_delta_is_clipped_above_before_it_is_weighted() -> None:
    judged = EndogenousReward(settings(), pixel_l1).evaluate(step(grey(0, 255), grey(255, 0), goals=grey(255, 255)))
    np.testing.assert_allclose(judged.dense, [0.1, -0.5])


@pytest.mark.parametrize("mode", ["delta", "progress"])
def test_no_cycle_is_paid(mode: str) -> None:
    reward = EndogenousReward(settings(mode=mode), pixel_l1)
    slowly_there_and_back_at_once = np.float32([0, 0.2, 0.4, 0.6, 0.8, 0])
    for near in (slowly_there_and_back_at_once, *RANDOM.random((20, 8), np.float32)):
        lap = np.append(near, near[0])
        assert reward.approach(lap[:-1], lap[1:]).sum() <= 1e-6
        assert float(reward.approach(*map(torch.from_numpy, (lap[:-1], lap[1:]))).sum()) <= 1e-6


def test_abs_is_the_weighted_similarity_and_not_clipped() -> None:
    judged = EndogenousReward(settings(mode="abs"), pixel_l1).evaluate(step(grey(0), grey(51), goals=grey(255)))
    np.testing.assert_allclose(judged.dense, [0.5 * 0.2], atol=1e-6)


def test_progress_counts_steps_along_the_golden_trajectory_and_ignores_its_padding() -> None:
    golden = grey(0, 50, 100, 150, 200, 200)[None].repeat(3, 0)
    lengths = np.array([5, 5, 3])
    judged = EndogenousReward(settings(mode="progress", dense_clip=1.0, dense_weight=1.0), pixel_l1).evaluate(
        step(grey(0, 110, 0), grey(55, 40, 255), golden=golden, golden_lengths=lengths)
    )
    np.testing.assert_allclose(judged.dense, [1 / 4, -1 / 4, 1.0])


def test_sparse_is_paid_strictly_above_the_threshold() -> None:
    before = grey(0, 0, 0)
    threshold = np.float32(0.7)
    probability = np.array([np.nextafter(threshold, np.float32(0)), threshold, 0.8], np.float32)
    judged = EndogenousReward(settings(dense_weight=0.0, success_threshold=float(threshold)), pixel_l1).evaluate(
        replace(step(before, before), success_probability=probability)
    )
    np.testing.assert_array_equal(judged.sparse, [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(judged.success, [SUCCESS_NO, SUCCESS_NO, SUCCESS_YES])


def test_sparse_is_not_paid_above_the_uncertainty_limit_and_zero_switches_the_limit_off() -> None:
    given = replace(step(grey(0, 0), grey(0, 0), 1.0), uncertainty=np.array([0.1, 0.3], np.float32))
    limited = EndogenousReward(settings(dense_weight=0.0, uncertainty_limit=0.2), pixel_l1).evaluate(given)
    np.testing.assert_array_equal(limited.sparse, [2.0, 0.0])
    free = EndogenousReward(settings(dense_weight=0.0), pixel_l1).evaluate(given)
    np.testing.assert_array_equal(free.sparse, [2.0, 2.0])


def test_a_missing_goal_is_invalid_with_its_reason_and_nan_never_zero() -> None:
    model = EndogenousReward(settings(), pixel_l1)
    some = model.evaluate(step(grey(0, 0), grey(9, 9), goals=grey(9, 9), goal_found=np.array([True, False])))
    np.testing.assert_array_equal(some.valid, [True, False])
    assert np.isnan(some.total[1]) and np.isnan(some.dense[1]) and np.isnan(some.sparse[1])
    assert some.invalid_reason == "no goal (environments [1])"
    none = model.evaluate(step(grey(0), grey(9)))
    assert not none.valid.any() and np.isnan(none.total).all()
    assert EndogenousReward(settings(dense_weight=0.0), pixel_l1).evaluate(step(grey(0), grey(9))).valid.all()


@pytest.mark.parametrize("model", [EndogenousReward(settings(dense_weight=0.0), pixel_l1), RuleReward()])
def test_a_done_signal_that_is_not_finite_stays_missing(model: EndogenousReward | RuleReward) -> None:
    judged = model.evaluate(step(grey(0), grey(0), float("nan")))
    assert not judged.valid.any() and np.isnan(judged.total).all()
    assert judged.success[0] == SUCCESS_UNKNOWN and "not finite" in judged.invalid_reason


def test_a_distance_that_is_not_finite_stays_missing() -> None:
    class Broken:
        name = "broken"

        def __call__(self, images: UInt8Array, others: UInt8Array) -> np.ndarray[Any, np.dtype[np.float32]]:
            return np.full(len(images), np.nan, np.float32)

    judged = EndogenousReward(settings(), Broken()).evaluate(step(grey(0), grey(9), goals=grey(9)))
    assert not judged.valid.any() and np.isnan(judged.total).all() and "not finite" in judged.invalid_reason


def test_a_step_that_was_not_made_has_no_reward_and_needs_no_reason() -> None:
    given = replace(step(grey(0, 0), grey(9, 9), 1.0, goals=grey(9, 9)), valid=np.array([False, True]))
    for model in (EndogenousReward(settings(), pixel_l1), RuleReward()):
        judged = model.evaluate(given)
        np.testing.assert_array_equal(judged.valid, [False, True])
        assert np.isnan(judged.total[0]) and judged.success[0] == SUCCESS_UNKNOWN and judged.invalid_reason == ""


def test_components_sum_to_the_total_and_scoring_again_is_bit_equal() -> None:
    images = RANDOM.integers(0, 256, (3, 6, SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
    given = step(images[0], images[1], 0.9, goals=images[2])
    model = EndogenousReward(settings(), pixel_l1)
    first, second = model.evaluate(given), model.evaluate(given)
    assert first.total.tobytes() == second.total.tobytes()
    np.testing.assert_array_equal(sum(first.components.values()), first.total)


def test_rule_pays_the_simulators_success() -> None:
    given = replace(step(grey(0, 0), grey(0, 0)), success_probability=np.array([0, 1], np.float32))
    np.testing.assert_array_equal(RuleReward(3.0).evaluate(given).total, [0.0, 3.0])
    with pytest.raises(ValueError, match="sparse_weight"):
        RuleReward(float("nan"))


def test_the_version_changes_with_every_setting_and_distance() -> None:
    versions = {
        EndogenousReward(settings(), pixel_l1).version,
        EndogenousReward(settings(dense_clip=0.3), pixel_l1).version,
        EndogenousReward(settings(), EncoderDistance(lambda images: images.float().flatten(1), 2.0)).version,
        RuleReward().version,
        RuleReward(2.0).version,
    }
    assert len(versions) == 5 and all(0 <= version < 2**64 for version in versions)
    assert EndogenousReward(settings(), pixel_l1).version == EndogenousReward(settings(), pixel_l1).version


@pytest.mark.parametrize(("dense", "same"), [({"dense_weight": 0.0}, True), ({"mode": "abs"}, True), ({}, False)])
def test_what_was_paid_when_falling_back_was_clipped_is_another_version(dense: dict[str, Any], same: bool) -> None:
    config = settings(**dense)
    former = version_of("endogenous", config.model_dump_json(), pixel_l1.name)
    assert (EndogenousReward(config, pixel_l1).version == former) == same


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="goals must be uint8"):
        step(grey(0), grey(0), goals=grey(0, 0))
    with pytest.raises(ValueError, match="images must be uint8"):
        step(grey(0).astype(np.float32), grey(0))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"valid must have shape \(1,\)"):
        replace(step(grey(0), grey(0)), valid=np.ones(2, bool))
    with pytest.raises(ValueError, match=r"golden_lengths must lie in 2\.\.3"):
        step(grey(0), grey(0), golden=grey(0, 1, 2)[None], golden_lengths=np.array([4]))
    with pytest.raises(ValueError, match="two uint8"):
        pixel_l1(grey(0), grey(0, 0))


def distances() -> list[Distance]:
    mean = EncoderDistance(lambda images: images.float().mean((1, 2)), scale=10.0)
    return [pixel_l1, mean]


def test_every_distance_is_zero_for_equal_images_symmetric_and_positive_otherwise() -> None:
    images, others = RANDOM.integers(0, 256, (2, 3, 64, 64, 3), dtype=np.uint8)
    for distance in distances():
        np.testing.assert_array_equal(distance(images, images), np.zeros(3), err_msg=distance.name)
        np.testing.assert_allclose(distance(images, others), distance(others, images), rtol=1e-5)
        assert (distance(images, others) > 0).all() and distance(images, others).dtype == np.float32


def test_pixel_and_encoder_distances_match_numbers_worked_by_hand() -> None:
    np.testing.assert_allclose(pixel_l1(grey(0, 100), grey(255, 151)), [1.0, 0.2], rtol=1e-6)
    encode = EncoderDistance(lambda images: images.float().mean((1, 2)), scale=10.0)
    np.testing.assert_allclose(encode(grey(0), grey(25)), [2.5])


def test_a_scale_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="scale must be finite and > 0, got 0"):
        EncoderDistance(lambda images: images.float(), scale=0.0)
