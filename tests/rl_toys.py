"""What the learning tests share: small settings, a rollout that pays for one direction, and a learner rank to spawn."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from graph.toy import ReachToy, make_policy

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import PpoConfig
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.rollouts import collect_rollout
from wm_nodes.reward import RuleReward
from wm_nodes.training.ranks import Ranks, broadcast_rollout
from wm_nodes.training.weights import save_weights

NUM_ENVS, STEPS = 6, 10


def toy_policy() -> ImagePolicy:
    return make_policy(load_config("smoke"))


def toy_ppo(**changes: Any) -> PpoConfig:
    settings = {"epochs": 2, "minibatch_size": 16, "value_warmup_updates": 0, "target_kl": 0.0, **changes}
    return load_config("base").ppo.model_copy(update=settings)


def toy_rollout(
    policy: ImagePolicy, version: int = 1, *, steps: int = STEPS, seed: int = 0, envs_per_start: int = 1
) -> Rollout:
    return collect_rollout(ReachToy(NUM_ENVS, 0), policy, RuleReward(), steps, seed, version, envs_per_start)


def learner_rank(rank: int, size: int, folder: str, changes: dict[str, Any], updates: int) -> None:
    """One process of a learner: rank 0 collects and gives its rollouts to the others; every rank saves its weights."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=size)
    ranks = Ranks(rank, size)
    policy = toy_policy()
    learner = PpoLearner(policy, toy_ppo(**changes), seed=5, ranks=ranks)
    for version in range(1, updates + 1):
        own = toy_rollout(policy, version) if rank == 0 else None
        rollout = broadcast_rollout(own, ranks)
        assert rollout is not None and rollout.policy_version == version
        learner.update(rollout)
    assert broadcast_rollout(None, ranks) is None
    save_weights(policy, Path(folder) / f"rank{rank}.safetensors")
    dist.destroy_process_group()


def paying_for_the_first_axis(rollout: Rollout) -> Rollout:
    """The same rollout as one-step episodes whose reward is the action's first component."""
    arrays = {name: getattr(rollout, name) for name in rollout.__dataclass_fields__}
    arrays["rewards_TN"] = np.ascontiguousarray(rollout.actions_TN[..., 0])
    arrays["terminated_TN"] = np.ones_like(rollout.terminated_TN)
    arrays["truncated_TN"] = np.zeros_like(rollout.truncated_TN)
    return Rollout(**arrays)
