"""Intervals against published examples, symmetry, and exact coverage."""

import itertools
import math

import numpy as np
import pytest

from wm_nodes.core.statistics import (
    mcnemar_exact,
    newcombe_difference,
    paired_difference,
    t_interval,
    wilson_interval,
)


def test_wilson_matches_newcombes_published_examples() -> None:
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson_interval(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


def test_wilson_is_symmetric_and_says_nothing_without_episodes() -> None:
    low, high = wilson_interval(3, 17)
    assert wilson_interval(14, 17) == pytest.approx((1 - high, 1 - low))
    assert wilson_interval(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match=r"0\.\.episodes"):
        wilson_interval(5, 4)


def test_newcombe_difference_matches_the_published_example() -> None:
    assert newcombe_difference(56, 70, 48, 80) == pytest.approx((0.0524, 0.3339), abs=5e-5)


def test_equal_rates_agree_and_far_ones_do_not() -> None:
    def agree(*counts: int) -> bool:
        low, high = newcombe_difference(*counts)
        return low <= 0 <= high

    assert agree(50, 100, 100, 200)
    assert not agree(90, 100, 50, 100)
    assert agree(0, 0, 7, 7)


def test_mcnemar_is_the_two_sided_binomial_tail() -> None:
    assert mcnemar_exact(5, 0) == 2 / 32
    assert mcnemar_exact(0, 5) == 2 / 32
    assert mcnemar_exact(3, 1) == 2 * (1 + 4) / 16
    assert mcnemar_exact(2, 2) == 1.0
    assert mcnemar_exact(0, 0) == 1.0


def test_paired_difference_counts_each_pair_once() -> None:
    found = paired_difference([True, True, False, False, False], [True, False, True, True, False])
    assert (found.kept, found.lost, found.gained, found.failed) == (1, 1, 2, 1)
    assert found.difference == pytest.approx(0.2)
    assert found.low < found.difference < found.high


def _pairs(kept: int, lost: int, gained: int, failed: int) -> tuple[list[bool], list[bool]]:
    before = [True] * kept + [True] * lost + [False] * gained + [False] * failed
    after = [True] * kept + [False] * lost + [True] * gained + [False] * failed
    return before, after


def test_paired_interval_flips_sign_with_the_order_of_the_two_results() -> None:
    before, after = _pairs(10, 3, 12, 25)
    forward, backward = paired_difference(before, after), paired_difference(after, before)
    assert (forward.low, forward.high) == pytest.approx((-backward.high, -backward.low))


def test_paired_interval_without_discordant_pairs_contains_zero_and_is_not_a_point() -> None:
    found = paired_difference(*_pairs(20, 0, 0, 30))
    assert found.low < 0 < found.high
    assert found.low == pytest.approx(-(1.959963984540054**2) / (50 + 1.959963984540054**2), abs=1e-6)


def test_paired_interval_covers_close_to_95_percent_by_exact_enumeration() -> None:
    episodes, lost_rate, gained_rate = 24, 0.15, 0.35
    covered = 0.0
    for lost, gained in itertools.product(range(episodes + 1), repeat=2):
        rest = episodes - lost - gained
        if rest < 0:
            continue
        weight = math.comb(episodes, lost) * math.comb(episodes - lost, gained)
        weight *= lost_rate**lost * gained_rate**gained * (1 - lost_rate - gained_rate) ** rest
        found = paired_difference(*_pairs(rest, lost, gained, 0))
        covered += weight * (found.low <= gained_rate - lost_rate <= found.high)
    assert 0.93 < covered < 0.975


def test_paired_lengths_must_match() -> None:
    with pytest.raises(ValueError, match="equally long"):
        paired_difference([True], [True, False])
    with pytest.raises(ValueError, match="not empty"):
        paired_difference([], [])


def test_the_interval_of_three_values_is_the_one_worked_by_hand() -> None:
    """Differences 1, 2, 3: mean 2, standard deviation 1, t(2) = 4.303."""
    found = t_interval([1.0, 2.0, 3.0])
    assert (found.mean, found.low, found.high) == pytest.approx((2.0, 2 - 4.303 / 3**0.5, 2 + 4.303 / 3**0.5))
    assert not found.separable and t_interval([1.0, 1.1, 0.9]).separable
    with pytest.raises(ValueError, match="got 1"):
        t_interval([1.0])


def test_the_interval_of_noise_covers_its_mean_in_19_cases_of_20() -> None:
    generator = np.random.default_rng(0)
    for pairs in (3, 8, 12):
        covered = sum(not t_interval(generator.normal(size=pairs).tolist()).separable for _ in range(2000))
        assert covered / 2000 == pytest.approx(0.95, abs=0.017)
