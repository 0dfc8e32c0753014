"""The detector of reward hacking, DD-2."""

import numpy as np
import pytest

from wm_nodes.video_rl.reward_hacking import find_hacked_metrics, slope


def test_the_slope_of_a_line_is_exact_and_has_no_error() -> None:
    assert slope([1.0, 3.0, 5.0, 7.0]) == pytest.approx((2.0, 0.0))


def test_a_reward_that_rises_while_the_truth_falls_is_named_and_one_that_rises_with_it_is_not() -> None:
    reward, falling, rising = [0.1, 0.2, 0.3, 0.4], [0.9, 0.8, 0.7, 0.6], [0.2, 0.3, 0.4, 0.5]
    found = find_hacked_metrics(reward, {"mass": falling, "obeyed": rising}, window=4)
    assert found == {"mass": pytest.approx(-0.1)}


def test_only_the_last_evaluations_count() -> None:
    reward, truth = [0.5, 0.4, 0.3, 0.4, 0.5, 0.6], [0.9, 0.5, 0.1, 0.2, 0.3, 0.4]
    assert not find_hacked_metrics(reward, {"mass": truth}, window=4)
    assert not find_hacked_metrics(reward[:2], {"mass": truth[:2]}, window=4)


@pytest.mark.parametrize("window", [3, 4, 8])
def test_two_flat_noisy_curves_hardly_ever_raise_an_alarm(window: int) -> None:
    generator, cases = np.random.default_rng(0), 4000
    draw = lambda: generator.normal(size=window).tolist()  # noqa: E731
    alarms = sum(bool(find_hacked_metrics(draw(), {"mass": draw()}, window=window)) for _ in range(cases))
    assert alarms <= 0.002 * cases
