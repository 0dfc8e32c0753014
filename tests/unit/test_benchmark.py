"""The benchmark's own parts: what it counts and how it alternates."""

import itertools

import numpy as np

from wm_nodes.benchmark.inputs import actions_of, interleave, seeds_of
from wm_nodes.benchmark.simulator import rate_episode
from wm_nodes.benchmark.stages import fresh_pictures
from wm_nodes.benchmark.still import make_still_environment
from wm_nodes.config.load import load_config
from wm_nodes.reward import RuleReward


def test_contenders_alternate_and_the_first_block_does_not_count() -> None:
    order: list[str] = []

    def contender(name: str, block: int) -> int:
        order.append(f"{name}{block}")
        return block

    found = interleave([lambda block: contender("a", block), lambda block: contender("b", block)], 2)
    assert order == ["a0", "b0", "a1", "b1", "a2", "b2"]
    assert found == [[1, 2], [1, 2]]


def test_pictures_of_the_reward_stage_are_never_seen_twice() -> None:
    images = np.zeros((2, 8, 8, 3), np.uint8)
    seen = [pictures.tobytes() for pictures in itertools.islice(fresh_pictures(images), 600)]
    assert len(set(seen)) == len(seen)
    assert not images.any()


def test_the_costless_environment_never_ends_so_that_every_step_counts() -> None:
    env = make_still_environment(load_config("cpu", {}), 4, 0)
    env.reset(None, seeds_of(env.spec, 0))
    for actions in actions_of(env.spec, 0, 3 * env.spec.max_episode_steps):
        assert env.step(actions).valid.all()
    assert rate_episode(env, RuleReward(), 1).steps_per_s > 0
