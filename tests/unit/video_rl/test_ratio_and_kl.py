"""Advantages, ratio, objective, KL: numbers by hand, limits, torch's distributions. Ids: spec 4.1."""

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal, kl_divergence
from torch.testing import assert_close
from video_toys import mean_logprob, randn

from wm_nodes.video_rl.group_advantages import GroupAdvantages, best_of_n, group_advantages
from wm_nodes.video_rl.ratio_and_kl import (
    clip_tails,
    clipped_objective,
    log_ratio,
    log_space_kl,
    mean_kl,
)

M, U = 3, 8192
EPS = 1e-4


def advantages(
    rewards: list[float], groups: list[int] | None = None, clip: float = 2.5, **options: object
) -> GroupAdvantages:
    of = torch.tensor(groups or [0] * len(rewards))
    return group_advantages(torch.tensor(rewards, dtype=torch.float64), of, clip=clip, **options)  # type: ignore[arg-type]


def gaussians() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x_s, the old and the new mean, and a deviation per cell, (M, U), float64."""
    std = 0.1 + 0.5 * torch.rand(M, U, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    old = randn(M, U, seed=1, dtype=torch.float64)
    new = old + 0.01 * randn(M, U, seed=2, dtype=torch.float64)
    return old + std * randn(M, U, seed=3, dtype=torch.float64), old, new, std


# DD-13: advantages


def test_an_advantage_is_the_distance_from_the_group_s_mean_in_its_deviations() -> None:
    """(1, 2, 3) has population deviation sqrt(2/3)."""
    wanted = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    assert_close(advantages([1, 2, 3]).advantages_N, wanted / math.sqrt(2 / 3))


def test_groups_do_not_see_each_other() -> None:
    """Interleaved groups of scales that differ by a thousand."""
    found = advantages([1, 1000, 3, 3000, 2, 2000], [7, 3, 7, 3, 7, 3])
    high = math.sqrt(1.5)
    assert_close(found.advantages_N, torch.tensor([-high, -high, high, high, 0, 0], dtype=torch.float64))
    assert (found.num_groups, found.num_zero_std) == (2, 0)
    assert bool(found.kept_N.all())


def test_before_the_clip_every_group_has_mean_zero_and_deviation_one_and_the_clip_keeps_the_order() -> None:
    """4 groups of 16."""
    rewards = randn(64, seed=5).exp().exp().tolist()
    groups = torch.arange(4).repeat_interleave(16)
    free = advantages(rewards, groups.tolist(), clip=1e9).advantages_N.view(4, 16)
    assert_close(free.mean(1), torch.zeros(4, dtype=torch.float64), atol=1e-6, rtol=0)
    assert_close(free.std(1, correction=0), torch.ones(4, dtype=torch.float64), atol=1e-6, rtol=0)
    clipped = advantages(rewards, groups.tolist()).advantages_N.view(4, 16)
    assert float(free.max()) > 2.5 and float(clipped.abs().max()) == 2.5
    for row, own, reward in zip(clipped, free, torch.tensor(rewards).view(4, 16), strict=True):
        assert bool((row[reward.argsort()].diff() >= 0).all())
        assert torch.equal(row[own.abs() < 2.5], own[own.abs() < 2.5])


@pytest.mark.parametrize("size", [12, 16, 24])
def test_equal_float32_rewards_of_0_7_have_no_advantage_at_all(size: int) -> None:
    """The usual float32 form gives up to 0.89."""
    rewards = torch.full((size,), 0.7)
    found = group_advantages(rewards, torch.zeros(size), clip=2.5)
    assert not found.advantages_N.any() and not found.kept_N.any() and found.num_zero_std == 1


def test_a_spread_below_the_floor_is_none_and_the_floor_grows_with_the_mean() -> None:
    assert advantages([0.0, 1e-7]).num_zero_std == 1
    assert advantages([0.0, 1e-5]).num_zero_std == 0
    assert advantages([1e4, 1e4 + 1e-3]).num_zero_std == 1
    assert advantages([1e4, 1e4 + 1e-1]).num_zero_std == 0


def test_the_largest_advantage_of_a_group_is_the_root_of_its_size_less_one() -> None:
    """A clip of 5 cannot fire up to G = 26."""
    for size, high in ((8, math.sqrt(7)), (26, 5.0)):
        found = advantages([1.0] + [0.0] * (size - 1), clip=100.0).advantages_N
        assert float(found[0]) == pytest.approx(high)


def test_videos_without_a_reward_count_in_no_statistic_and_do_not_train() -> None:
    found = advantages([1, math.nan, 3, math.inf])
    assert_close(found.advantages_N, torch.tensor([-1.0, 0, 1, 0], dtype=torch.float64))
    assert found.kept_N.tolist() == [True, False, True, False]


def test_a_group_trains_with_two_rewards_and_with_half_of_its_videos() -> None:
    """RA-15: two of four and three of five do, two of five and one of two do not."""
    nan = math.nan
    rewards = [1, 3, nan, nan, 1, 2, 3, nan, nan, 1, 2, nan, nan, nan, 5, nan]
    found = advantages(rewards, [0] * 4 + [1] * 5 + [2] * 5 + [3] * 2)
    assert found.kept_N.nonzero().flatten().tolist() == [0, 1, 4, 5, 6]
    assert (found.num_groups, found.num_dropped, found.num_zero_std) == (4, 2, 2)
    assert not found.advantages_N[9:].any()


def test_a_global_deviation_is_that_of_all_groups_about_their_own_means() -> None:
    """Deviations (-1, 1) and (-3, 3): the mean square is 5."""
    found = advantages([0, 2, 10, 16], [0, 0, 1, 1], std_scope="global").advantages_N
    assert_close(found, torch.tensor([-1.0, 1, -3, 3], dtype=torch.float64) / math.sqrt(5))


# best of N


def test_best_of_8_of_16_keeps_the_4_best_and_the_4_worst_of_each_group() -> None:
    order = torch.randperm(16, generator=torch.Generator().manual_seed(0))
    signal = torch.cat([order.double() - 7.5, -(order.double() - 7.5)])
    kept = best_of_n(signal, torch.arange(2).repeat_interleave(16), torch.ones(32, dtype=torch.bool), 8)
    assert kept.sum() == 16
    assert sorted(signal[:16][kept[:16]].tolist()) == [-7.5, -6.5, -5.5, -4.5, 4.5, 5.5, 6.5, 7.5]
    assert torch.equal(kept[:16], kept[16:]), "a mirrored group keeps the same videos"


def test_equal_advantages_are_kept_by_their_index() -> None:
    kept = best_of_n(torch.zeros(6), torch.zeros(6), torch.ones(6, dtype=torch.bool), 4)
    assert kept.tolist() == [True, True, False, False, True, True]


def test_an_odd_best_of_n_keeps_one_more_of_the_worst_and_small_groups_stay_whole() -> None:
    signal, everyone = torch.tensor([3.0, 1, 2, 5, 4]), torch.ones(5, dtype=torch.bool)
    assert best_of_n(signal, torch.zeros(5), everyone, 3).tolist() == [False, True, True, True, False]
    for n in (0, 5, 9):
        assert best_of_n(signal, torch.zeros(5), everyone, n).all()


def test_videos_that_do_not_train_are_not_among_the_best() -> None:
    kept = best_of_n(torch.tensor([9.0, 1, 2, 3, -9]), torch.zeros(5), torch.tensor([0, 1, 1, 1, 0]).bool(), 2)
    assert kept.tolist() == [False, True, False, True, False]


# DD-15: ratio


def test_the_ratio_from_normalised_noise_is_the_difference_of_two_log_probabilities() -> None:
    x, old, new, std = gaussians()
    direct = log_ratio((x - new) / std, (x - old) / std)
    assert_close(direct, mean_logprob(x, new, std) - mean_logprob(x, old, std), atol=1e-12, rtol=0)


def test_one_cell_moved_by_a_quarter_deviation_has_the_ratio_worked_by_hand() -> None:
    """zeta 1 -> 0.75: (1 - 0.5625) / 2."""
    old, new = torch.tensor([[1.0]]), torch.tensor([[0.75]])
    assert float(log_ratio(new, old)) == pytest.approx(0.21875)
    assert float(log_ratio(new, old, 2 * 0.5**2)) == pytest.approx(0.109375), "CPS at std 0.5"
    assert float(mean_kl(new, old)) == pytest.approx(0.03125)


def test_unmoved_noise_has_a_ratio_of_exactly_one_under_every_weight() -> None:
    """DD-15."""
    zeta = randn(M, U, seed=4)
    for weight in (1.0, torch.rand(M, U)):
        assert log_ratio(zeta, zeta.clone(), weight).tolist() == [0.0] * M
    x, old, _, std = (value.float() for value in gaussians())
    by_difference = mean_logprob(x, old, std) - mean_logprob(old + std * ((x - old) / std), old, std)
    assert float((by_difference.exp() - 1).abs().max()) < 1e-6


def test_the_cps_ratio_is_that_of_minus_the_mean_square_error() -> None:
    x, old, new, std = gaussians()
    found = log_ratio((x - new) / std, (x - old) / std, 2 * std.square())
    assert_close(found, (x - old).square().mean(1) - (x - new).square().mean(1))


# DD-16: objective


def test_the_objective_takes_the_smaller_of_the_plain_and_the_clipped_term() -> None:
    logs = torch.tensor([0.5, 1.5, 0.5, 1.5]).log()
    found = clipped_objective(logs, torch.tensor([2.0, 2, -2, -2]), 0.2)
    assert_close(found, torch.tensor([1.0, 2.4, -1.6, -3.0]))


@pytest.mark.parametrize(
    ("ratio", "advantage", "moves"),
    [(1 - 2 * EPS, -1.0, False), (1 - 2 * EPS, 1.0, True), (1 + 2 * EPS, 1.0, False), (1 + 2 * EPS, -1.0, True),
     (1.0, 1.0, True), (1.0, -1.0, True)],
)
def test_a_ratio_that_has_gone_far_enough_in_its_direction_has_no_gradient(
    ratio: float, advantage: float, moves: bool
) -> None:
    logs = torch.tensor([math.log(ratio)], dtype=torch.float64, requires_grad=True)
    clipped_objective(logs, torch.tensor([advantage], dtype=torch.float64), EPS).sum().backward()
    assert logs.grad is not None
    assert float(logs.grad) == (pytest.approx(advantage * ratio) if moves else 0.0)


@pytest.mark.parametrize("clip", [1e-9, 1e-4, 0.2])
def test_at_a_ratio_of_one_the_gradient_is_the_advantage_for_every_clip(clip: float) -> None:
    logs = torch.zeros(2, requires_grad=True)
    clipped_objective(logs, torch.tensor([1.5, -0.5]), clip).sum().backward()
    assert logs.grad is not None
    assert_close(logs.grad, torch.tensor([1.5, -0.5]))


def test_the_tails_are_counted_apart() -> None:
    logs = torch.tensor([0.9, 0.95, 1.0, 1.05, 1.2, 1.3, 1.4, 1.5]).log()
    assert clip_tails(logs, 0.07) == (1, 4)


# DD-17: KL


def test_the_mean_space_kl_is_that_of_two_normals_of_one_deviation() -> None:
    x, old, new, std = gaussians()
    assert_close(
        mean_kl((x - new) / std, (x - old) / std),
        kl_divergence(Normal(new, std), Normal(old, std)).mean(1),
        rtol=1e-6, atol=0,
    )


def test_the_kl_at_its_anchor_is_zero_with_zero_gradient() -> None:
    target = randn(M, U, seed=4)
    zeta = target.clone().requires_grad_()
    total = mean_kl(zeta, target) + log_space_kl(log_ratio(zeta, target))
    total.sum().backward()
    assert total.tolist() == [0.0] * M and zeta.grad is not None and not zeta.grad.any()


def test_the_log_space_kl_is_never_negative_and_far_weaker_than_the_mean_space_one() -> None:
    """Here by a factor of hundreds; at smaller moves of thousands."""
    x, old, new, std = gaussians()
    new_zeta, old_zeta = (x - new) / std, (x - old) / std
    strong = mean_kl(new_zeta, old_zeta)
    weak = log_space_kl(log_ratio(new_zeta, old_zeta))
    assert bool((weak >= 0).all()) and bool((strong > 500 * weak).all())


def test_the_log_space_kl_of_a_doubled_probability_is_half_its_logarithm_squared() -> None:
    assert float(log_space_kl(torch.tensor([math.log(2)]))) == pytest.approx(math.log(2) ** 2 / 2)
