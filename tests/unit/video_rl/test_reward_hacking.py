"""The detector of reward hacking, DD-2."""

import numpy as np
import pytest

from wm_nodes.video_rl.reward_hacking import find_hacked_metrics, slope


def test_the_slope_of_a_line_is_exact_and_has_no_error() -> None:
    assert slope([1.0, 3.0, 5.0, 7.0]) == pytest.approx((2.0, 0.0))


def test_a_reward_that_rises_while_the_truth_falls_is_named_and_one_that_rises_with_it_is_not() -> None:
    reward, falling, rising = [0.1, 0.2, 0.3, 0.4], [0.9, 0.8, 0.7, 0.6], [0.2, 0.3, 0.4, 0.5]
    found = find_hacked_metrics(reward, {"mass": falling, "obeyed": rising})
    assert found == {"mass": pytest.approx(-0.1)}


@pytest.mark.parametrize("evaluations", [3, 4, 8])
def test_two_flat_noisy_curves_hardly_ever_raise_an_alarm(evaluations: int) -> None:
    generator, cases = np.random.default_rng(0), 4000
    draw = lambda: generator.normal(size=evaluations).tolist()  # noqa: E731
    alarms = sum(bool(find_hacked_metrics(draw(), {"mass": draw()})) for _ in range(cases))
    assert alarms <= 0.002 * cases
