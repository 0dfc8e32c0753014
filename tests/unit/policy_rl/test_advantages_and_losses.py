"""Advantages and losses against numbers worked by hand and a brute-force sum. RS-10a to RS-10c, RS-10e."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from wm_nodes.policy_rl.advantages import (
    GroupAdvantages,
    explained_variance,
    gae,
    group_advantages,
    masked_normalise,
)
from wm_nodes.policy_rl.losses import approximate_kl, clip_fraction, clipped_policy_loss, value_loss


def column(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)[:, None]


def flags(*values: int) -> Tensor:
    return torch.tensor(values, dtype=torch.bool)[:, None]


NONE, ALL = flags(0, 0, 0), flags(1, 1, 1)


def test_lambda_zero_gives_one_step_errors() -> None:
    advantages, returns = gae(
        column(1, 2, 4), column(10, 20, 30), column(20, 30, 8), NONE, NONE, ALL, gamma=0.5, lambda_=0.0
    )
    assert_close(advantages, column(1 + 10 - 10, 2 + 15 - 20, 4 + 4 - 30))
    assert_close(returns, column(11, 17, 8))


def test_lambda_one_gives_the_discounted_sum_of_rewards_and_the_last_bootstrap() -> None:
    _, returns = gae(column(1, 2, 4), column(10, 20, 30), column(20, 30, 8), NONE, NONE, ALL, gamma=0.5, lambda_=1.0)
    assert_close(returns, column(1 + 0.5 * (2 + 0.5 * 8), 2 + 0.5 * 8, 4 + 0.5 * 8))


def test_truncated_step_bootstraps_from_the_reached_observation_and_terminated_step_does_not() -> None:
    rewards, values, reached = column(1, 2, 4), column(10, 20, 30), column(20, 100, 8)
    _, truncated = gae(rewards, values, reached, NONE, flags(0, 1, 0), ALL, gamma=0.5, lambda_=1.0)
    assert_close(truncated, column(1 + 0.5 * 52, 2 + 0.5 * 100, 8))
    _, terminated = gae(rewards, values, reached, flags(0, 1, 0), NONE, ALL, gamma=0.5, lambda_=1.0)
    assert_close(terminated, column(2, 2, 8))


def test_invalid_step_is_skipped_even_when_its_reward_is_nan_and_the_sum_stops_before_it() -> None:
    advantages, returns = gae(
        column(1, math.nan, 4), column(10, 20, 30), column(20, 30, 8), NONE, NONE, flags(1, 0, 1),
        gamma=0.5, lambda_=1.0,
    )
    assert_close(advantages, column(1 + 10 - 10, 0, 4 + 4 - 30))
    assert_close(returns, column(11, 0, 8))


def test_valid_nan_reward_is_an_error_that_names_step_and_environment() -> None:
    with pytest.raises(ValueError, match=r"step 1 of environment 0 .*reward .nan"):
        gae(column(1, math.nan, 4), column(1, 1, 1), column(1, 1, 1), NONE, NONE, ALL, gamma=0.5, lambda_=1.0)


def test_shapes_that_differ_are_an_error() -> None:
    with pytest.raises(ValueError, match="one shape"):
        gae(column(1, 2), column(1, 1, 1), column(1, 1, 1), NONE, NONE, ALL, gamma=0.5, lambda_=1.0)


@pytest.mark.parametrize("seed", range(20))
def test_recursion_equals_the_explicit_sum(seed: int) -> None:
    random = np.random.default_rng(seed)
    steps, envs, gamma, lambda_ = 9, 4, 0.9, 0.8
    rewards, values, reached = random.normal(size=(3, steps, envs))
    terminated = random.random((steps, envs)) < 0.2
    truncated = (random.random((steps, envs)) < 0.2) & ~terminated
    valid = random.random((steps, envs)) < 0.8
    expected = np.zeros((steps, envs))
    for n in range(envs):
        for t in range(steps):
            for k in range(t, steps):
                if not valid[k, n]:
                    break
                bootstrap = 0.0 if terminated[k, n] else reached[k, n]
                expected[t, n] += (gamma * lambda_) ** (k - t) * (rewards[k, n] + gamma * bootstrap - values[k, n])
                if terminated[k, n] or truncated[k, n]:
                    break
    arrays = (torch.from_numpy(a) for a in (rewards, values, reached, terminated, truncated, valid))
    advantages, _ = gae(*arrays, gamma=gamma, lambda_=lambda_)
    np.testing.assert_allclose(advantages.numpy(), expected, atol=1e-12)


def groups_of_three(
    rewards: list[list[float]], ended: list[list[int]], valid: list[list[int]] | None = None, **how: bool
) -> GroupAdvantages:
    """Of rows (one per step) of two groups of three environments. ended: 1 terminated, 2 truncated."""
    flags = torch.tensor(ended)
    known = torch.ones_like(flags) if valid is None else torch.tensor(valid)
    return group_advantages(torch.tensor(rewards), flags == 1, flags == 2, known.bool(), group_size=3, **how)


def test_group_advantages_are_the_distance_from_the_groups_mean_in_its_deviations() -> None:
    """Returns 1, 0, 0 | 3, 2, 1; the fourth environment pays twice; what follows an end is of later episodes."""
    rewards = [[0.0, 0, 0, 2, 2, 0], [1, 0, 0, 1, 9, 1], [9, 0, 0, 0, 9, 9]]
    ended = [[0, 0, 0, 0, 1, 0], [1, 0, 0, 0, 0, 1], [0, 2, 0, 1, 1, 0]]
    found = groups_of_three(rewards, ended)
    first, second = math.sqrt(2), math.sqrt(1.5)  # (1 - 1 / 3) / (sqrt(2) / 3); (3 - 2) / sqrt(2 / 3)
    both = [first, -first / 2, -first / 2, second, 0, -second]
    counted = torch.tensor([[1, 1, 1, 1, 1, 1], [1, 1, 1, 1, 0, 1], [0, 1, 1, 1, 0, 0]], dtype=torch.bool)
    assert torch.equal(found.counted_TN, counted)
    assert_close(found.advantages_TN, torch.tensor(both).expand(3, 6) * counted)
    assert (found.groups_without_signal, found.episodes_without_return) == (0, 0)
    plain = groups_of_three(rewards, ended, by_std=False).advantages_TN[0]
    assert_close(plain, torch.tensor([2 / 3, -1 / 3, -1 / 3, 1.0, 0.0, -1.0]))
    others = groups_of_three(rewards, ended, by_std=False, leave_one_out=True).advantages_TN[0]
    assert_close(others, torch.tensor([1 - 0, 0 - 1 / 2, 0 - 1 / 2, 3 - 3 / 2, 2 - 2, 1 - 5 / 2]))


def test_a_group_of_equal_returns_trains_nothing_and_is_counted() -> None:
    """0.7 = 0.1 + 0.6 = 0.35 + 0.35 but for rounding."""
    rewards = [[0.1, 0.6, 0.35, 0, 0, 0], [0.6, 0.1, 0.35, 0, 1, 0]]
    for how in ({}, {"by_std": False}, {"leave_one_out": True}):
        found = groups_of_three(rewards, [[0] * 6, [2] * 6], **how)
        assert not found.advantages_TN[:, :3].any() and found.advantages_TN[:, 3:].all()
        assert (found.groups_without_signal, found.episodes_without_return) == (1, 0)
        assert found.counted_TN.all()


def test_an_episode_with_a_missing_reward_is_left_out_and_its_group_is_the_others() -> None:
    nan = math.nan
    rewards = [[0.0, nan, 0, 0, nan, nan], [1, 5, 0, 1, 1, 0], [nan, 5, nan, nan, nan, nan]]
    ended = [[0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0]]
    valid = [[1, 0, 1, 1, 0, 0], [1, 1, 1, 1, 1, 1], [0, 1, 0, 0, 0, 0]]
    found = groups_of_three(rewards, ended, valid)
    assert_close(found.advantages_TN[:2], torch.tensor([[1.0, 0, -1, 0, 0, 0]] * 2))
    assert torch.equal(found.counted_TN, torch.tensor([[1, 0, 1, 1, 0, 0]] * 2 + [[0] * 6], dtype=torch.bool))
    assert (found.groups_without_signal, found.episodes_without_return) == (1, 3), "one alone has nothing to compare"
    alone = groups_of_three(rewards, ended, valid, by_std=False, leave_one_out=True).advantages_TN
    assert_close(alone[0], torch.tensor([1.0, 0, -1, 0, 0, 0]))


def test_a_valid_reward_that_is_not_finite_is_an_error_that_names_the_environment() -> None:
    with pytest.raises(ValueError, match=r"environment 4 are valid and sum to nan; mark the missing valid=False"):
        groups_of_three([[0.0, 0, 0, 0, math.nan, 0]], [[1] * 6])


def test_normalisation_uses_only_masked_entries() -> None:
    values, mask = torch.tensor([1.0, 3.0, 1000.0]), torch.tensor([True, True, False])
    assert_close(masked_normalise(values, mask, epsilon=0.0), torch.tensor([-1.0, 1.0, 0.0]))


def test_normalisation_does_not_blow_up_what_varies_less_than_the_floor() -> None:
    values, mask = torch.tensor([0.01, 0.03]), torch.tensor([True, True])
    assert_close(masked_normalise(values, mask, epsilon=0.0, floor=0.1), torch.tensor([-0.1, 0.1]))
    assert_close(masked_normalise(100 * values, mask, epsilon=0.0, floor=0.1), torch.tensor([-1.0, 1.0]))


def test_normalisation_of_one_or_no_entry_gives_zeros() -> None:
    values = torch.tensor([5.0, 7.0])
    assert_close(masked_normalise(values, torch.tensor([True, False])), torch.zeros(2))
    assert_close(masked_normalise(values, torch.tensor([False, False])), torch.zeros(2))


def test_explained_variance_is_one_for_perfect_values_and_zero_for_a_constant() -> None:
    returns, mask = torch.tensor([1.0, 2.0, 3.0, 99.0]), torch.tensor([True, True, True, False])
    assert explained_variance(returns, returns, mask) == pytest.approx(1.0)
    assert explained_variance(torch.full((4,), 2.0), returns, mask) == pytest.approx(0.0)
    assert math.isnan(explained_variance(returns, torch.ones(4), mask))


def test_policy_loss_stops_paying_for_a_ratio_beyond_the_clip() -> None:
    old = torch.zeros(4)
    new = torch.tensor([1.5, 1.5, 0.5, 0.5]).log()
    advantages = torch.tensor([2.0, -2.0, 2.0, -2.0])
    assert_close(clipped_policy_loss(new, old, advantages, clip=0.2), torch.tensor([-2.4, 3.0, -1.0, 1.6]))


def test_policy_gradient_vanishes_where_the_clip_binds() -> None:
    new = torch.tensor([1.5, 1.1]).log().requires_grad_()
    clipped_policy_loss(new, torch.zeros(2), torch.ones(2), clip=0.2).sum().backward()
    assert new.grad is not None
    assert_close(new.grad, torch.tensor([0.0, -1.1]))


def test_value_loss_is_half_the_square_then_linear() -> None:
    values, returns = torch.tensor([3.0, 12.0]), torch.zeros(2)
    assert_close(value_loss(values, values, returns, clip=0.0), torch.tensor([4.5, 10 * (12 - 5.0)]))


def test_clipped_value_loss_is_the_larger_of_both() -> None:
    values, old, returns = torch.tensor([3.0, 0.0]), torch.tensor([0.0, 3.0]), torch.tensor([3.0, 0.0])
    assert_close(value_loss(values, old, returns, clip=1.0), torch.tensor([2.0, 2.0]))


def test_kl_estimate_and_clip_fraction() -> None:
    new = torch.tensor([2.0, 1.0, 0.9]).log()
    assert_close(approximate_kl(new, torch.zeros(3)), torch.tensor([1 - math.log(2), 0.0, -0.1 - math.log(0.9)]))
    assert_close(clip_fraction(new, torch.zeros(3), clip=0.2), torch.tensor([1.0, 0.0, 0.0]))
