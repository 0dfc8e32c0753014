"""A rollout as tensors on one device, with the policy's features in place of pictures: what PPO computes with.

Shapes: T time, N environments, F features, S state, A action, H W 3 image.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.core.types import BoolArray, FloatArray, Rollout, UInt8Array
from wm_nodes.policy_rl.image_policy import ImagePolicy


class Outcomes(Protocol):
    """The columns (T, N) that say how episodes went; see Rollout."""

    @property
    def rewards_TN(self) -> FloatArray: ...
    @property
    def terminated_TN(self) -> BoolArray: ...
    @property
    def truncated_TN(self) -> BoolArray: ...
    @property
    def valid_TN(self) -> BoolArray: ...


@dataclass(frozen=True)
class _Outcomes:
    rewards_TN: FloatArray
    terminated_TN: BoolArray
    truncated_TN: BoolArray
    valid_TN: BoolArray


@dataclass(frozen=True)
class TensorRollout:
    """T lock-steps of N environments, as Rollout, on one device.

    features_TN: float32 (T, N, F) of the observations that the actions answer; next_features_TN: of those that the
        steps reached, as next_states_TN; they count only where needs_bootstrap().
    images: uint8 (T + 1, N, H, W, 3), what the environments showed before every step and after the last; None where the
        pictures were never here.
    """

    features_TN: Tensor
    next_features_TN: Tensor
    states_TN: Tensor
    next_states_TN: Tensor
    actions_TN: Tensor
    logprobs_TN: Tensor
    values_TN: Tensor
    rewards_TN: Tensor
    terminated_TN: Tensor
    truncated_TN: Tensor
    valid_TN: Tensor
    policy_version: int
    images: Tensor | None = None

    def needs_bootstrap(self) -> Tensor:
        """Where (T, N) the value of the observation that a step reached is no other row's: at cuts, before a missing
        step, and at the end."""
        return _needs_bootstrap(self.valid_TN, self.terminated_TN, self.truncated_TN)

    def outcomes(self) -> Outcomes:
        """The small columns on the host, in one copy."""
        columns = (self.rewards_TN, self.terminated_TN, self.truncated_TN, self.valid_TN)
        rewards, *flags = torch.stack([column.float() for column in columns]).cpu().numpy()
        return _Outcomes(rewards, *(flag.astype(np.bool_) for flag in flags))

    def pictures(self, envs: slice = slice(None)) -> UInt8Array:
        """Copy pictures (T + 1, n, H, W, 3) of the environments `envs` to the host. Raises ValueError without any."""
        if self.images is None:
            raise ValueError("this rollout has no pictures; its Rollout holds them")
        pictures: UInt8Array = self.images[:, envs].cpu().numpy()
        return pictures


@torch.no_grad()
def tensors_of(rollout: Rollout, policy: ImagePolicy) -> TensorRollout:
    """The rollout with the features of `policy`, on its device; those of reached observations only where needed."""

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(policy.device)

    steps, num_envs = rollout.valid_TN.shape
    flags = (torch.from_numpy(flag) for flag in (rollout.valid_TN, rollout.terminated_TN, rollout.truncated_TN))
    needed = np.flatnonzero(_needs_bootstrap(*flags).numpy())  # on the host, which need not ask the device
    images, reached = (i.reshape(-1, *i.shape[2:]) for i in (rollout.images_TN, rollout.next_images_TN))
    features = policy.features(images)
    following = torch.zeros_like(features)
    following[tensor(needed)] = policy.features(reached[needed])
    shape = (steps, num_envs, -1)
    return TensorRollout(
        features.view(shape), following.view(shape), tensor(rollout.states_TN), tensor(rollout.next_states_TN),
        tensor(rollout.actions_TN), tensor(rollout.logprobs_TN), tensor(rollout.values_TN),
        tensor(rollout.rewards_TN), tensor(rollout.terminated_TN), tensor(rollout.truncated_TN),
        tensor(rollout.valid_TN), rollout.policy_version,
    )


def _needs_bootstrap(valid_TN: Tensor, terminated_TN: Tensor, truncated_TN: Tensor) -> Tensor:
    next_lost_TN = torch.ones_like(valid_TN)
    next_lost_TN[:-1] = ~valid_TN[1:]
    return valid_TN & ~terminated_TN & (truncated_TN | next_lost_TN)
