"""A learner of your own, here regression on the actions that were paid best; see policy_rl/training_run.py:Learner.

python -m wm_nodes.policy_rl.train --preset smoke --set learner.factory=examples.own_learner:make
"""
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import Canceled
from wm_nodes.training.checkpoint import (
    optimizer_tensors,
    read_checkpoint,
    restore_optimizer,
    section,
    write_checkpoint,
)


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
        loss: Tensor = (means - actions).square().mean()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        return {"loss": float(loss), "samples": float(best.sum())}

    def save(self, path: Path) -> None:
        write_checkpoint(path, {"optimizer": optimizer_tensors(self._optimizer)}, {})

    def load(self, path: Path) -> None:
        restore_optimizer(self._optimizer, section(read_checkpoint(path)[0], "optimizer"))


def make(policy: ImagePolicy, config: RunConfig) -> BestActionsLearner:
    return BestActionsLearner(policy, config)
