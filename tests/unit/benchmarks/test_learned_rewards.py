"""Rewards learned from success in place of the world model's done signal."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from model_folders import make_model_folder, write_starts
from unit.benchmarks.test_reward_test import CONFIG, EPISODES, recorded

from benchmarks.environments import learned_rewards, reward_test
from benchmarks.environments.learned_rewards import (
    EMBEDDING,
    PROXY,
    Learned,
    best_threshold,
    environment_paid_by,
    paid_by_verdicts,
)
from benchmarks.environments.reward_test import imagine_all, learned_heads
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl import factories
from wm_nodes.policy_rl.factories import models_of


def test_the_best_threshold_lies_between_scores() -> None:
    scores, won = np.array([0.1, 0.4, 0.5, 0.9]), np.array([False, False, True, True])
    assert best_threshold(scores, won) == pytest.approx(0.45)
    assert best_threshold(scores, np.ones(4, np.bool_)) < 0.1
    with pytest.raises(ValueError, match="none of 4 episodes succeeds"):
        best_threshold(scores, np.zeros(4, np.bool_))


@pytest.mark.parametrize("reward", [EMBEDDING, PROXY])
def test_the_environment_ends_where_the_learned_reward_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reward: Learned
) -> None:
    """Under recorded actions, from the recordings' first frames, its signal is the reward's value, shifted."""
    monkeypatch.setattr(reward_test, "PROXY_ITERATIONS", 20)
    folder = make_model_folder(tmp_path / "model")
    models, real = models_of(folder), recorded()
    seen = imagine_all(models, real, "push_cube")
    size = seen.features.shape[-1] + 1
    for module in (reward_test, learned_rewards):  # least squares on 28 steps of noise would magnify rounding
        monkeypatch.setattr(module, "embedding_weights", lambda _: np.random.default_rng(0).normal(0, 0.01, size))
    monkeypatch.setattr(learned_rewards, "episodes_learned_from", lambda *_: seen)
    images, states = seen.real.images[:, 0], seen.real.states[:, 0]
    monkeypatch.setattr(factories, "load_starts", lambda *_: (images, states))
    monkeypatch.setattr(factories, "load_start_instructions", lambda *_: ())
    config = CONFIG.with_values(ppo=CONFIG.ppo.with_values(num_envs=EPISODES))
    place: Any = SimpleNamespace(config=config, model_dir=folder, start=(write_starts(tmp_path / "starts"), None))
    env = environment_paid_by(reward, place, EPISODES, tmp_path)
    env.episodes.reset(torch.ones(EPISODES, dtype=torch.bool), torch.arange(EPISODES))
    env._episode_ids[:] = 1
    result = env.step(real.actions[:, 0])
    values = learned_heads(seen, folder, 0)[reward](seen)
    value, shift = values[:, 0], config.reward.success_threshold - best_threshold(values[:, -1], seen.won)
    np.testing.assert_allclose(result.success_probability, value + shift, atol=2e-2)
    assert (result.terminated == (result.success_probability > config.reward.success_threshold)).all()


def test_learned_rewards_refuse_noise_on_what_they_read() -> None:
    noisy = CONFIG.with_values(imagined_environment=CONFIG.imagined_environment.with_values(picture_noise=0.5))
    place: Any = SimpleNamespace(config=noisy, model_dir=Path("none"))
    with pytest.raises(ValueError, match=r"picture_noise is 0\.5, and learned rewards .* set it to 0"):
        environment_paid_by(EMBEDDING, place, EPISODES, Path("none"))


def test_the_reward_agent_pays_the_last_step_of_each_whole_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environment 0 succeeds at step 1 and is reset, then time is over; 1 is cut by the rollout's end."""
    T, N = 6, 2
    ended = np.zeros((3, T, N), np.bool_)
    terminated, truncated, valid = ended[0], ended[1], ~ended[2]
    terminated[1, 0], truncated[5, 0], valid[2, 0] = True, True, False
    images = np.arange(T * N, dtype=np.uint8).reshape(T, N, 1, 1, 1)
    some = np.ones((T, N), np.float32)
    rollout = Rollout(
        images_TN=images, next_images_TN=images + 100, states_TN=some[..., None], next_states_TN=some[..., None],
        actions_TN=some[..., None], logprobs_TN=some, values_TN=some, rewards_TN=some, terminated_TN=terminated,
        truncated_TN=truncated, valid_TN=valid, policy_version=1,
    )
    seen = list[list[int]]()

    def pay(episodes: Any, _: Any) -> Any:
        seen.extend(frames.ravel().tolist() for frames, _, _ in episodes)
        assert all(len(frames) == len(actions) + 1 for frames, actions, _ in episodes)
        return np.array([0.25, 0.75])

    monkeypatch.setattr(learned_rewards, "paid_episodes", pay)
    paid = paid_by_verdicts(rollout, "push", CONFIG).rewards_TN
    assert seen == [[0, 2, 102], [6, 8, 10, 110]]
    assert paid[1, 0] == 0.25 and paid[5, 0] == 0.75 and paid.sum() == 1
