"""The world model with a reward learned from success in place of its done signal, to train policies in.

Shapes: B batch, T steps, S tokens, D width, K done heads, J tasks, N environments, F features.
"""

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benchmarks.environments.policies import Workplace
from benchmarks.environments.reward_test import (
    embedding_values,
    embedding_weights,
    episodes_learned_from,
    paid_episodes,
    proxy_network,
    proxy_values,
)
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import BoolArray, Rollout
from wm_nodes.judge.episode_reward import check_horizon
from wm_nodes.policy_rl.factories import imagined_by, make_learner, models_of
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import collect_rollout, rollout_statistics, terminate_at_episode_end
from wm_nodes.reward import RuleReward
from wm_nodes.world_model import DeviceEnvironment, ImaginedEpisodes, WorldModels
from wm_nodes.world_model.dynamics import pooled_features

Learned = Literal["embedding head", "proxy network"]
EMBEDDING, PROXY = get_args(Learned)


class EmbeddingHead(nn.Module):
    """A value linear in the pooled features, in place of DoneHeads: every head and task has it.

    Args:
        weights: and bias, (F + 1,).
        like: the heads that it stands for.
    """

    def __init__(self, weights: NDArray[np.float64], like: Any) -> None:
        super().__init__()
        self.num_heads, self.num_tasks = like.num_heads, like.num_tasks
        self.register_buffer("weights", torch.from_numpy(weights).float())

    def forward(
        self, tokens_BTSD: Tensor, register_BTD: Tensor, told_BTKJ: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The logit of the value (B, T, K, J), inside (0, 1), and no positions."""
        pooled = pooled_features(tokens_BTSD, register_BTD).float()
        weights = self.get_buffer("weights")
        logits = ((pooled * weights[:-1]).sum(-1) + weights[-1]).logit(1e-6)  # no bfloat16, as a matrix product would
        return logits[..., None, None].expand(*logits.shape, self.num_heads, self.num_tasks), pooled[..., :0]


class PaidByLatents(DeviceEnvironment):
    """Its done signal is a value of the imagined latents.

    Args:
        value: features (N, F), see Tokenizer.flatten -> (N,). The others as DeviceEnvironment's.
    """

    def __init__(self, *args: Any, value: Callable[[Tensor], Tensor], **named: Any) -> None:
        super().__init__(*args, **named)
        self._value = value

    def _predict(
        self, actions_NA: Tensor, moved_NP: Tensor, valid_N: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        frames, _, spread = super()._predict(actions_NA, moved_NP, valid_N, noise)
        return frames, self._value(self._tokenizer.flatten(self.imagined[0].latents_NSD, "latents")), 0 * spread


def best_threshold(scores: NDArray[np.float64], won: BoolArray) -> float:
    """The middle between two scores (E,) above which success has the best F1 with `won` (E,).

    Raises:
        ValueError: none has won.
    """
    if not won.any():
        raise ValueError(f"none of {len(won)} episodes succeeds, and a reward is learned from success; take more")
    ordered = np.unique(scores)
    between = np.concatenate([[ordered[0] - 1], (ordered[1:] + ordered[:-1]) / 2])
    called = scores[None] > between[:, None]
    f1 = 2 * (called & won).sum(1) / np.maximum(called.sum(1) + won.sum(), 1)
    return float(between[f1.argmax()])


def environment_paid_by(reward: Learned, place: Workplace, episodes: int, work: Path) -> ImaginedEpisodes:
    """The world model, whose episodes end in success where a learned reward says so.

    The reward is learned from simulator episodes in training scenes; its value is shifted so that the one with the best
    F1 on the imagined ones of them is reward.success_threshold.

    Args:
        episodes: that it is learned from. work: folder of these.

    Raises:
        ValueError: imagined_environment.picture_noise is set; or as best_threshold.
    """
    config = place.config
    if noise := config.imagined_environment.picture_noise:
        raise ValueError(f"imagined_environment.picture_noise is {noise}, and learned rewards read pictures without "
                         "noise; set it to 0")
    models = models_of(place.model_dir, config.device)
    seen = episodes_learned_from(config, models, episodes, work)

    def shift(values: NDArray[np.float64]) -> float:
        return config.reward.success_threshold - best_threshold(values[:, -1], seen.won)

    if reward == EMBEDDING:
        weights, action = embedding_weights(seen), copy.deepcopy(models.action)
        weights[-1] += shift(embedding_values(weights, seen))
        action.done = EmbeddingHead(weights, action.done)  # type: ignore[assignment]

        def make(models: WorldModels, *args: Any, **named: Any) -> DeviceEnvironment:
            return DeviceEnvironment(replace(models, action=action), *args, **named)
    else:
        network = proxy_network(seen, place.model_dir, config.seed)
        more = shift(proxy_values(network, place.model_dir, seen))
        make = partial(PaidByLatents, value=lambda features: network(features.float())[..., 0].sigmoid() + more)
    made = imagined_by(make, config, place.model_dir, place.start[0], config.ppo.num_envs)
    return ImaginedEpisodes(made, seed=config.seed)


def train_by_verdicts(place: Workplace, policy: ImagePolicy, imagined: ImaginedEpisodes) -> Iterator[float]:
    """Train in place, paid by the reward agent at the end of each episode (RA-15), as the graph is; the success rate of
    each update's rollout, by the done signal. Raises ValueError as check_horizon and paid_episodes."""
    config = place.config
    check_horizon(config.ppo.num_steps, imagined.spec.max_episode_steps)
    learner = make_learner(policy, config)
    for version in range(1, config.ppo.updates + 1):
        rollout = collect_rollout(
            imagined, policy, RuleReward(), config.ppo.num_steps, config.seed, version, config.ppo.envs_per_start
        )
        learner.update(terminate_at_episode_end(paid_by_verdicts(rollout, imagined.spec.instruction, config)))
        yield rollout_statistics(rollout).success_rate


def paid_by_verdicts(rollout: Rollout, instruction: str, config: RunConfig) -> Rollout:
    """The rollout with the reward agent's reward at the last step of each episode that ended, and none elsewhere. A
    last step without a verdict is not valid."""
    rewards, ends, episodes = np.zeros_like(rollout.rewards_TN), list[tuple[int, int]](), []
    for env in range(rewards.shape[1]):
        first = 0
        for step in range(len(rewards)):
            if not rollout.valid_TN[step, env]:
                first = step + 1
            elif rollout.terminated_TN[step, env] or rollout.truncated_TN[step, env]:
                frames = np.stack([*rollout.images_TN[first : step + 1, env], rollout.next_images_TN[step, env]])
                episodes.append((frames, rollout.actions_TN[first : step + 1, env], instruction))
                ends.append((step, env))
    if ends:
        rewards[tuple(np.array(ends).T)] = paid_episodes(episodes, config)
    said = np.isfinite(rewards)
    return replace(rollout, rewards_TN=np.where(said, rewards, np.float32(0)), valid_TN=rollout.valid_TN & said)
