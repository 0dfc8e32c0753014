"""Agreement measures against values worked by hand and published ones."""

import math

import numpy as np
import pytest

from wm_nodes.core.statistics import (
    auroc,
    balanced_accuracy,
    bootstrap_ratio,
    effective_size,
    expected_calibration_error,
    kappa,
    wilson_interval,
    wilson_of_groups,
    wilson_of_share,
)


def test_balanced_accuracy_gives_half_to_a_judge_that_always_passes() -> None:
    labels = [True] * 95 + [False] * 5
    assert balanced_accuracy(labels, [True] * 100) == 0.5
    assert balanced_accuracy([True, True, True, True, False, False], [True, True, True, False, False, True]) == (
        pytest.approx((3 / 4 + 1 / 2) / 2)
    )
    assert math.isnan(balanced_accuracy([True, True], [True, False]))


def test_balanced_accuracy_counts_a_decision_as_often_as_its_weight() -> None:
    assert balanced_accuracy([True, True, False], [True, False, False], [3, 1, 9]) == pytest.approx((3 / 4 + 1) / 2)


def test_kappa_matches_the_textbook_table() -> None:
    # 2 x 2 table 20 5 / 10 15: p_o = .7, p_e = .5 * .6 + .5 * .4 = .5, kappa = .4
    first = [True] * 25 + [False] * 25
    second = [True] * 20 + [False] * 5 + [True] * 10 + [False] * 15
    assert kappa(first, second) == pytest.approx(0.4)
    assert kappa(second, first) == pytest.approx(0.4)
    assert kappa(first, first) == 1
    assert kappa([True, True, False, False], [False, False, True, True]) == pytest.approx(-1)


def test_quadratic_kappa_forgives_a_neighbour_and_not_the_other_end() -> None:
    # observed: mean (i - j)^2 = 1 / 4; by chance: variances 5 / 4 and 11 / 16, means 1 / 4 apart, 2 together
    near = kappa([0, 1, 2, 3], [0, 1, 2, 2], weighting="quadratic")
    far = kappa([0, 1, 2, 3], [0, 1, 2, 0], weighting="quadratic")
    assert near == pytest.approx(1 - (1 / 4) / 2)
    assert far < near
    assert math.isnan(kappa([1, 1], [1, 1]))
    with pytest.raises(ValueError, match="same things"):
        kappa([1], [1, 2])


def test_calibration_error_is_the_mean_gap_of_the_bins() -> None:
    # bin .9: 2 of 4 pass, gap .4, 4 of 6; bin .0: 0 of 2 pass at .05, gap .05
    p_pass = [0.9, 0.9, 0.9, 0.9, 0.05, 0.05]
    labels = [True, True, False, False, False, False]
    assert expected_calibration_error(labels, p_pass) == pytest.approx((4 * 0.4 + 2 * 0.05) / 6)
    assert expected_calibration_error([True, False], [1.0, 0.0]) == 0
    assert math.isnan(expected_calibration_error([], []))
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        expected_calibration_error([True], [1.5])


def test_auroc_counts_pairs_in_order_and_ties_half() -> None:
    # pairs pass > fail: (.9 > .5), (.9 > .1), (.5 = .5), (.5 > .1) = 3.5 of 4
    assert auroc([True, True, False, False], [0.9, 0.5, 0.5, 0.1]) == pytest.approx(3.5 / 4)
    assert auroc([False, True], [0.9, 0.1]) == 0
    assert math.isnan(auroc([True, True], [0.9, 0.5]))
    with pytest.raises(ValueError, match="NaN"):
        auroc([True, False], [math.nan, 0.5])


def test_what_belongs_together_counts_once_in_an_interval() -> None:
    groups, correct = np.repeat(np.arange(10), 6), np.repeat(np.arange(10) < 8, 6)
    assert wilson_of_groups(correct, groups) == pytest.approx((0.8, *wilson_interval(8, 10)))
    assert wilson_of_groups(correct, np.arange(60)) == wilson_of_share(correct)
    top, bottom = np.linspace(1, 2, 10), np.linspace(3, 5, 10)
    whole = bootstrap_ratio(top, bottom, np.arange(10), seed=0)
    assert bootstrap_ratio(top.repeat(6), bottom.repeat(6), groups, seed=0) == pytest.approx(whole)


def test_weighted_share_has_wilsons_interval_at_its_effective_size() -> None:
    assert effective_size([2, 2, 2]) == pytest.approx(3)
    assert effective_size([1, 0, 0]) == 1
    assert effective_size([]) == 0
    correct = np.arange(100) < 91
    assert wilson_of_share(correct) == pytest.approx((0.91, *wilson_interval(91, 100)))
    assert wilson_of_share(correct)[1:] == pytest.approx((0.838, 0.952), abs=5e-4)
    share, low, high = wilson_of_share([True, False], [3, 1])
    assert share == 0.75
    assert (low, high) == pytest.approx(wilson_interval(0.75 * 1.6, 1.6))
    assert wilson_of_share([])[1:] == (0.0, 1.0)
