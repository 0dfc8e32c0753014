"""A learner of your own, regression on the actions that were paid best; see Learner in policy_rl/learner.py.

python -m wm_nodes.policy_rl.train --learner.factory examples.own_learner:BestActionsLearner
    --preset smoke --updates 3 --ppo.num_steps 16
"""
from pathlib import Path
from typing import Any

import torch

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import Canceled, TensorRollout, tensors_of
from wm_nodes.training import checkpoint


class BestActionsLearner:
    def __init__(self, policy: ImagePolicy, config: RunConfig) -> None:
        self._policy = policy
        self._optimizer = torch.optim.Adam(policy.actor.parameters(), config.ppo.learning_rate)

    def update(self, rollout: Rollout | TensorRollout, *, should_stop: Any = None) -> dict[str, float]:
        if should_stop and should_stop():
            raise Canceled
        data = tensors_of(rollout, self._policy)
        returns_TN = data.rewards_TN.flip(0).cumsum(0).flip(0)
        best = data.valid_TN & (returns_TN >= returns_TN[data.valid_TN].mean())
        means = self._policy.distribution(data.features_TN[best], data.states_TN[best]).mean_BA
        self._optimizer.zero_grad()
        torch.autograd.backward((means - data.actions_TN[best]).square().mean())
        self._optimizer.step()
        return {"samples": float(best.sum())}

    def save(self, path: Path) -> None:
        checkpoint.write_checkpoint(path, {"optimizer": checkpoint.optimizer_tensors(self._optimizer)}, {})

    def load(self, path: Path) -> None:
        state = checkpoint.section(checkpoint.read_checkpoint(path)[0], "optimizer")
        checkpoint.restore_optimizer(self._optimizer, state)
