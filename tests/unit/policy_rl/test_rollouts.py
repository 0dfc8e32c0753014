"""The lock-step collector: same seeds, same rollout; resets in place of steps; what an episode counts as."""

from dataclasses import replace

import numpy as np
import pytest
from graph.toy import ReachToy
from rl_toys import NUM_ENVS, STEPS, toy_policy, toy_rollout

from wm_nodes.config.load import load_config
from wm_nodes.config.seed_ranges import EVALUATION
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.rollouts import Convergence, action_noise, collect_rollout, reset_seeds, rollout_statistics
from wm_nodes.reward import RewardInput, RewardResult, RuleReward


def assert_same(first: Rollout, second: Rollout) -> None:
    for name in first.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def test_one_seed_gives_one_rollout_bit_for_bit_and_another_gives_another() -> None:
    policy = toy_policy()
    assert_same(toy_rollout(policy), toy_rollout(policy))
    assert np.abs(toy_rollout(policy).actions_TN - toy_rollout(policy, seed=1).actions_TN).max() > 0
    assert np.abs(toy_rollout(policy).states_TN - toy_rollout(policy, version=2).states_TN).max() > 0


def test_shapes_and_dtypes_are_those_of_the_contract() -> None:
    rollout = toy_rollout(toy_policy())
    assert rollout.images_TN.shape == rollout.next_images_TN.shape == (STEPS, NUM_ENVS, 16, 16, 3)
    assert rollout.states_TN.shape == rollout.actions_TN.shape == (STEPS, NUM_ENVS, 3)
    for name in ("actions_TN", "states_TN", "logprobs_TN", "values_TN", "rewards_TN"):
        assert getattr(rollout, name).dtype == np.float32, name
    for name in ("terminated_TN", "truncated_TN", "valid_TN"):
        assert getattr(rollout, name).dtype == np.bool_ and getattr(rollout, name).shape == (STEPS, NUM_ENVS), name


def test_an_ended_environment_spends_the_next_lock_step_on_its_reset() -> None:
    rollout = collect_rollout(ReachToy(3, 0, max_episode_steps=4), toy_policy(), RuleReward(), 10, 0, 1)
    ended = rollout.terminated_TN | rollout.truncated_TN
    np.testing.assert_array_equal(rollout.valid_TN[1:], ~ended[:-1])
    assert ended.any()
    assert np.isnan(rollout.rewards_TN[~rollout.valid_TN]).all()
    assert np.isfinite(rollout.rewards_TN[rollout.valid_TN]).all()
    assert not ended[~rollout.valid_TN].any()


def test_each_step_starts_where_the_one_before_ended_and_each_reset_starts_anew() -> None:
    rollout = collect_rollout(ReachToy(3, 0, max_episode_steps=4), toy_policy(), RuleReward(), 10, 0, 1)
    goes_on = rollout.valid_TN[:-1] & rollout.valid_TN[1:]
    np.testing.assert_array_equal(rollout.next_states_TN[:-1][goes_on], rollout.states_TN[1:][goes_on])
    np.testing.assert_array_equal(rollout.next_images_TN[:-1][goes_on], rollout.images_TN[1:][goes_on])
    after_reset = ~rollout.valid_TN[:-1]
    assert (rollout.next_states_TN[:-1][after_reset] != rollout.states_TN[1:][after_reset]).any(-1).all()


def test_a_reward_that_cannot_be_given_makes_the_step_invalid_not_worthless() -> None:
    class Partial(RuleReward):
        def evaluate(self, step: RewardInput) -> RewardResult:
            probability = step.success_probability.copy()
            probability[1] = np.nan
            return super().evaluate(replace(step, success_probability=probability))

    rollout = collect_rollout(ReachToy(3, 0), toy_policy(), Partial(), 3, 0, 1)
    assert not rollout.valid_TN[:, 1].any() and np.isnan(rollout.rewards_TN[:, 1]).all()
    assert rollout.valid_TN[:, 0].all()


def test_training_resets_never_use_an_evaluation_seed() -> None:
    assert load_config("base").evaluation.first_seed >= EVALUATION.first
    assert reset_seeds(0, 1, 2, 10_000).max() < EVALUATION.first


def test_streams_differ_by_seed_version_and_step() -> None:
    keys = [(0, 1, 2), (1, 1, 2), (0, 2, 2), (0, 1, 3)]
    assert len({action_noise(*key, 4, 3).tobytes() for key in keys}) == 4
    assert len({reset_seeds(*key, 4).tobytes() for key in keys}) == 4
    np.testing.assert_array_equal(action_noise(0, 1, 2, 4, 3), action_noise(0, 1, 2, 4, 3))


def test_environments_of_a_group_begin_at_one_start_and_act_with_noise_of_their_own() -> None:
    rollout = collect_rollout(ReachToy(6, 0), toy_policy(), RuleReward(), 3, 0, 1, envs_per_start=3)
    states = rollout.states_TN[0].reshape(2, 3, 3)
    np.testing.assert_array_equal(states, states[:, :1].repeat(3, 1))
    assert (states[0, 0] != states[1, 0]).any()
    assert len(np.unique(rollout.actions_TN[0], axis=0)) == 6
    with pytest.raises(ValueError, match="6 environments are not whole groups of 4; set"):
        reset_seeds(0, 1, 0, 6, 4)


def test_too_few_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="steps must be >= 1, got 0"):
        collect_rollout(ReachToy(2, 0), toy_policy(), RuleReward(), 0, 0, 1)


def test_statistics_are_of_first_episodes_and_later_short_ones_do_not_count() -> None:
    base = toy_rollout(toy_policy(), steps=5)
    shape = (5, NUM_ENVS)
    valid, terminated, truncated = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape, bool)
    rewards = np.full(shape, np.nan, np.float32)
    valid[:, 0], rewards[:, 0] = True, [1, 2, 0, 4, 8]
    terminated[1, 0] = terminated[4, 0] = True
    valid[2, 0], rewards[2, 0] = False, np.nan
    valid[:3, 1], rewards[:3, 1], truncated[2, 1] = True, 0.5, True
    valid[:, 2], rewards[:, 2] = True, 1.0
    found = rollout_statistics(
        replace(base, valid_TN=valid, rewards_TN=rewards, terminated_TN=terminated, truncated_TN=truncated)
    )
    assert (found.episodes, found.successes, found.begun) == (2, 1, 3), "environment 0's second success is left out"
    assert found.cut == 1, "environment 2's, and no second one"
    assert found.success_rate == pytest.approx(1 / 3), "environment 2 did not succeed in the time there was"
    assert found.mean_return == pytest.approx((3 + 1.5) / 2)
    assert found.mean_length == pytest.approx((2 + 3) / 2)


def test_training_has_converged_after_enough_updates_in_a_row_without_a_failure() -> None:
    base = toy_rollout(toy_policy(), steps=2)
    ends = np.array([[False] * NUM_ENVS, [True] * NUM_ENVS])
    won = replace(base, terminated_TN=ends, truncated_TN=~ends & False, valid_TN=np.ones_like(ends))
    lost = replace(won, terminated_TN=ends & (np.arange(NUM_ENVS) > 0), truncated_TN=ends & (np.arange(NUM_ENVS) == 0))
    convergence = Convergence(2)
    assert [convergence.reached(rollout) for rollout in (won, lost, won, won)] == [False, False, False, True]
    assert not any(Convergence(0).reached(won) for _ in range(3)), "0 is never"


def test_statistics_without_an_ended_episode_are_missing_not_zero() -> None:
    base = toy_rollout(toy_policy(), steps=1)
    none = np.zeros((1, NUM_ENVS), bool)
    found = rollout_statistics(replace(base, terminated_TN=none, truncated_TN=none))
    assert (found.episodes, found.cut) == (0, NUM_ENVS)
    assert np.isnan([found.success_rate, found.mean_return, found.mean_length]).all()
