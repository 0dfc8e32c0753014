"""Evaluation: results in seed order, whatever the number of environments that play."""

import numpy as np
import pytest
from graph.toy import ReachToy
from rl_toys import toy_policy

from wm_nodes.core.statistics import wilson_interval
from wm_nodes.policy_rl.validation.evaluation import EvaluationResult, evaluate

FIRST_SEED = 1_000_000


def run(num_envs: int, episodes: int = 17, deterministic: bool = False) -> EvaluationResult:
    return evaluate(toy_policy(), ReachToy(num_envs, 0), episodes, FIRST_SEED, deterministic)


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_number_of_environments_does_not_change_the_result(deterministic: bool) -> None:
    one = run(1, deterministic=deterministic)
    for num_envs in (2, 5, 30):
        other = run(num_envs, deterministic=deterministic)
        np.testing.assert_array_equal(one.success, other.success)
        np.testing.assert_array_equal(one.length, other.length)
    assert one.successes > 0


def test_an_episode_depends_on_its_seed_only() -> None:
    whole = run(3)
    tail = evaluate(toy_policy(), ReachToy(3, 0), 7, FIRST_SEED + 10, False)
    np.testing.assert_array_equal(whole.success[10:], tail.success)
    np.testing.assert_array_equal(whole.length[10:], tail.length)


def test_failures_last_to_the_step_limit_and_the_interval_is_wilsons() -> None:
    found = run(4)
    assert (found.length[~found.success] == 12).all()
    assert (found.low, found.high) == wilson_interval(found.successes, 17)
    assert found.success_rate == found.successes / found.episodes == found.success.mean()
    assert found.mean_length == pytest.approx(found.length.mean())


def test_progress_ends_at_all_episodes() -> None:
    seen: list[tuple[int, int]] = []
    found = evaluate(toy_policy(), ReachToy(4, 0), 9, FIRST_SEED, on_progress=lambda *counts: seen.append(counts))
    assert seen[-1] == (9, found.successes)
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})
    with pytest.raises(ValueError, match="episodes must be >= 1"):
        evaluate(toy_policy(), ReachToy(4, 0), 0, FIRST_SEED)
