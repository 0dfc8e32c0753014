"""A learner that is not PPO, as a user would write one: REINFORCE with the mean return as baseline."""

from collections.abc import Callable
from pathlib import Path

import torch

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import Canceled, TensorRollout, tensors_of
from wm_nodes.training import checkpoint


class Reinforce:
    """loss = - mean of log pi(a_t | s_t) (G_t - mean G), G_t the discounted return from step t to its episode's end."""

    def __init__(self, policy: ImagePolicy, learning_rate: float, gamma: float) -> None:
        self.policy, self.gamma = policy, gamma
        self._optimizer = torch.optim.Adam(policy.actor.parameters(), learning_rate)

    def update(
        self, rollout: Rollout | TensorRollout, *, should_stop: Callable[[], bool] | None = None
    ) -> dict[str, float]:
        if should_stop is not None and should_stop():
            raise Canceled("stopped before the update")
        seen = tensors_of(rollout, self.policy)
        returns_TN, ahead_N = torch.zeros_like(seen.rewards_TN), torch.zeros_like(seen.rewards_TN[0])
        for t in reversed(range(len(returns_TN))):
            last_N = seen.terminated_TN[t] | seen.truncated_TN[t]
            ahead_N = torch.where(seen.valid_TN[t], seen.rewards_TN[t], 0.0) + self.gamma * ahead_N * ~last_N
            returns_TN[t] = ahead_N
        features, states, actions, returns = (
            column[seen.valid_TN] for column in (seen.features_TN, seen.states_TN, seen.actions_TN, returns_TN)
        )
        logprobs = self.policy.distribution(features, states).logprob(actions)
        loss = -(logprobs * (returns - returns.mean())).mean()
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        return {"loss_policy": loss.item(), "samples": len(returns)}

    def save(self, path: Path) -> None:
        checkpoint.write_checkpoint(path, {"optimizer": checkpoint.optimizer_tensors(self._optimizer)}, {})

    def load(self, path: Path) -> None:
        tensors, _ = checkpoint.read_checkpoint(path)
        checkpoint.restore_optimizer(self._optimizer, checkpoint.section(tensors, "optimizer."))


def make_reinforce(policy: ImagePolicy, config: RunConfig) -> Reinforce:
    return Reinforce(policy, config.ppo.learning_rate, config.ppo.gamma)
