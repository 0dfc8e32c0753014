"""An episode in the simulator depends on its seed and actions alone: not on those before it or beside it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.types import BoolArray, Episode, FloatArray, Observation, StepResult, UInt64Array
from wm_nodes.environments import collection
from wm_nodes.environments.collection import CollectionPlan, collect
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import scripted_episode
from wm_nodes.policy_rl.factories import make_policy
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.validation.evaluation import evaluate

CONFIG = load_config("smoke")
PUSHED = (1_000_003, 1_000_008, 1_000_016, 1_000_024)
"""Seeds whose pushes go on differently in physics that has simulated other episodes."""
SECOND_SHARD = 2_000_020
"""First of four seeds of which three pushes end up to 45 mm elsewhere in the physics of the four seeds before."""


class Watched(ManiSkillEnvironment):
    """Keeps the final ground truth of each episode by its reset seed."""

    def __init__(self, num_envs: int) -> None:
        super().__init__("push_cube", CONFIG.simulation, num_envs)
        self.seeds, self.ends = np.zeros(num_envs, np.uint64), dict[int, bytes]()

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        assert seeds is not None
        self.seeds = seeds if mask is None else np.where(mask, seeds, self.seeds)
        return super().reset(mask, seeds)

    def step(self, actions: FloatArray) -> StepResult:
        result = super().step(actions)
        for i in np.flatnonzero(result.terminated | result.truncated):
            self.ends[int(self.seeds[i])] = result.ground_truth[i].tobytes()
        return result


@pytest.fixture(scope="module")
def one() -> Iterator[Watched]:
    yield from _watched(1)


@pytest.fixture(scope="module")
def three() -> Iterator[Watched]:
    yield from _watched(3)


def _watched(num_envs: int) -> Iterator[Watched]:
    environment = Watched(num_envs)
    yield environment
    environment.close()


def replay(env: ManiSkillEnvironment, episodes: list[Episode]) -> None:
    """Play the episodes' seeds and actions side by side and compare every picture, state and ground truth."""
    longest = max(episode.num_steps for episode in episodes)
    actions = np.stack([np.pad(e.actions, ((0, longest - e.num_steps), (0, 0))) for e in episodes], 1)
    seen = env.reset(seeds=np.array([episode.seed for episode in episodes], np.uint64))
    for t in range(longest + 1):
        for i, episode in enumerate(episodes):
            if t <= episode.num_steps:
                where = f"seed {episode.seed}, step {t}, environment {i}"
                np.testing.assert_array_equal(env.ground_truth[i], episode.ground_truth[t], where)
                np.testing.assert_array_equal(seen.state[i], episode.states[t], where)
                np.testing.assert_array_equal(seen.image[i], episode.images[t], where)
        if t < longest:
            seen = env.step(actions[t]).observation


def test_an_episode_is_the_same_after_others_beside_others_and_in_any_order(one: Watched, three: Watched) -> None:
    episodes = [scripted_episode(one, "expert", seed, 1) for seed in PUSHED]
    replay(three, [episodes[3], episodes[2], episodes[1]])  # the first episodes of these simulators
    replay(three, [episodes[1], episodes[0], episodes[3]])
    for episode in reversed(episodes):
        replay(one, [episode])


def test_physics_that_is_not_renewed_remembers_earlier_episodes(one: Watched) -> None:
    env = ManiSkillEnvironment("push_cube", CONFIG.simulation, pictures=False, new_physics=False)
    episodes = [scripted_episode(env, "expert", seed, 1).ground_truth for seed in PUSHED]
    env.close()
    renewed = [scripted_episode(one, "expert", seed, 1).ground_truth for seed in PUSHED]
    np.testing.assert_array_equal(episodes[0], renewed[0])
    assert any(not np.array_equal(*pair) for pair in zip(episodes[1:], renewed[1:], strict=True))


@pytest.mark.slow
def test_a_shard_is_the_same_alone_and_after_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collection, "EPISODES_PER_SHARD", 4)
    written = dict[Path, list[Episode]]()

    def keep(path: Path, _: CollectionPlan, episodes: list[Episode]) -> None:
        written[path] = episodes

    both = CollectionPlan("push_cube", CONFIG.simulation, 8, SECOND_SHARD - 4, {"expert": 1.0})
    after = collect(tmp_path / "both", both, keep, num_workers=1)[1]
    collection._worker_environment.cache_clear()
    [alone] = collect(tmp_path / "alone", replace(both, num_episodes=4, first_seed=SECOND_SHARD), keep, num_workers=1)
    for one, other in zip(written[after], written[alone], strict=True):
        for name in ("ground_truth", "states", "actions", "images"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), f"seed {one.seed}, {name}")


@pytest.mark.slow
def test_evaluation_does_not_depend_on_the_number_of_simulators(one: Watched, three: Watched) -> None:
    policy = pushing_policy()
    results = [evaluate(policy, env, 5, 1_000_000, deterministic=False) for env in (one, three)]
    np.testing.assert_array_equal(results[0].success, results[1].success)
    np.testing.assert_array_equal(results[0].length, results[1].length)
    seeds = range(1_000_000, 1_000_005)
    assert [one.ends[seed] for seed in seeds] == [three.ends[seed] for seed in seeds]
    assert len({one.ends[seed] for seed in seeds}) == 5


def pushing_policy() -> ImagePolicy:
    """An untrained policy that goes down and away from the robot, and heeds what it sees."""
    policy = make_policy(CONFIG, shipped_model("push_cube"))
    with torch.no_grad():
        policy.actor.output.weight.mul_(50)
        policy.actor.output.bias.copy_(torch.tensor([0.4, 0.0, -0.6]))
    return policy
