"""A learner of your own, regression on the actions that were paid best; see Learner in policy_rl/learner.py.

python -m wm_nodes.policy_rl.train --learner.factory examples.own_learner:BestActionsLearner
    --preset smoke --updates 3 --ppo.num_steps 16
"""
from collections.abc import Callable
from pathlib import Path

import torch

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import Canceled
from wm_nodes.training import checkpoint


class BestActionsLearner:
    def __init__(self, policy: ImagePolicy, config: RunConfig) -> None:
        self._policy = policy
        self._optimizer = torch.optim.Adam(policy.actor.parameters(), config.ppo.learning_rate)

    def update(self, rollout: Rollout, *, should_stop: Callable[[], bool] | None = None) -> dict[str, float]:
        if should_stop and should_stop():
            raise Canceled
        returns_TN = rollout.rewards_TN[::-1].cumsum(0)[::-1]
        best = rollout.valid_TN & (returns_TN >= returns_TN[rollout.valid_TN].mean())
        states, actions = (torch.from_numpy(array[best]) for array in (rollout.states_TN, rollout.actions_TN))
        means = self._policy.distribution(self._policy.features(rollout.images_TN[best]), states).mean_BA
        self._optimizer.zero_grad()
        torch.autograd.backward((means - actions).square().mean())
        self._optimizer.step()
        return {"samples": float(best.sum())}

    def save(self, path: Path) -> None:
        checkpoint.write_checkpoint(path, {"optimizer": checkpoint.optimizer_tensors(self._optimizer)}, {})

    def load(self, path: Path) -> None:
        state = checkpoint.section(checkpoint.read_checkpoint(path)[0], "optimizer")
        checkpoint.restore_optimizer(self._optimizer, state)
