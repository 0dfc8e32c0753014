"""The rollout buffer of GRPO: sampled groups, their rewards, and everything a training step needs.

Shapes: N videos, S stochastic steps. The file is one safetensors; nothing in it is executed on load.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from wm_nodes.config.video import RolloutConfig
from wm_nodes.training.checkpoint import metadata_of
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.sampling import ROWS, VideoRollout

_METADATA_KEY = "rollout_buffer"
_ROLLOUT_TENSORS = (*ROWS, "noise_share")


class RolloutBufferError(ValueError):
    """A buffer that is damaged, of other weights, or was made with other sampler settings."""


def config_hash(settings: RolloutConfig) -> str:
    """Return the sha256 of what decides the Gaussian of a transition; storage_dtype does, since it rounds states."""
    knobs = settings.model_dump(exclude={"micro_batch", "buffer_device"})
    return hashlib.sha256(json.dumps(knobs, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class RolloutBuffer:
    """N videos in groups of one context each.

    rollout and condition may lie on any device; the others are in the host's memory.
    """

    rollout: VideoRollout
    """The videos."""
    condition: Condition
    """Of every video; rows repeat within a group."""
    group_ids: Tensor
    """int64 (N,)."""
    sample_ids: Tensor
    """Place in the group, int64 (N,)."""
    rewards: Mapping[str, Tensor]
    """Raw values by name, float64 (N,), NaN where missing."""
    policy_version: int
    """Optimizer steps of the weights that sampled."""
    iteration: int
    """Of the training run."""
    config_hash: str
    """Of the settings that sampled, see config_hash()."""

    def __len__(self) -> int:
        return len(self.group_ids)

    @property
    def reward(self) -> Tensor:
        """The reward that trains, float64 (N,): `total`, or the only one. Raises ValueError: there is neither."""
        if "total" not in self.rewards and len(self.rewards) != 1:
            raise ValueError(
                f"the buffer holds rewards {', '.join(self.rewards) or '(none)'} and no `total`; mix them first"
            )
        return self.rewards["total"] if "total" in self.rewards else next(iter(self.rewards.values()))

    @property
    def valid(self) -> Tensor:
        """bool (N,), which videos have a reward that trains."""
        return torch.isfinite(self.reward)

    def to(self, device: torch.device | str) -> "RolloutBuffer":
        """The same buffer with its videos and condition on a device."""
        return replace(self, rollout=self.rollout.to(device), condition=self.condition.to(device))

    def with_rewards(self, rewards: Mapping[str, Tensor]) -> "RolloutBuffer":
        """The same videos with rewards, from any device.

        Raises:
            RolloutBufferError: a reward is not one number per video.
        """
        values = {name: torch.as_tensor(value, dtype=torch.float64).cpu() for name, value in rewards.items()}
        for name, value in values.items():
            if value.shape != (len(self),):
                raise RolloutBufferError(f"reward {name} has shape {tuple(value.shape)}, the buffer {len(self)} videos")
        return replace(self, rewards=values)

    def check(self, settings: RolloutConfig, policy_version: int) -> None:
        """Raise RolloutBufferError if the buffer was sampled with other settings, or by other weights."""
        wanted = config_hash(settings)
        if self.config_hash != wanted:
            raise RolloutBufferError(
                f"the buffer was sampled with sampler settings {self.config_hash[:12]}, the learner has {wanted[:12]}: "
                f"its ratios would be wrong; sample again, or load the settings of that run"
            )
        if policy_version != self.policy_version:
            raise RolloutBufferError(
                f"the buffer comes from version {self.policy_version}, the learner is at {policy_version}; sample again"
            )

    def to_bytes(self) -> bytes:
        """One safetensors file; from_bytes gives an equal buffer."""
        header = {
            "steps": self.rollout.steps,
            "policy_version": self.policy_version,
            "iteration": self.iteration,
            "config_hash": self.config_hash,
        }
        tensors, seen = self._tensors(), set[int]()
        for name, tensor in tensors.items():  # safetensors refuses memory under two names, e.g. a total of one reward
            if tensor.data_ptr() in seen:
                tensors[name] = tensor.clone()
            seen.add(tensor.data_ptr())
        tensors = {name: tensor.cpu() for name, tensor in tensors.items()}
        data: bytes = save(tensors, {_METADATA_KEY: json.dumps(header)})
        return data

    @classmethod
    def from_bytes(cls, data: bytes) -> "RolloutBuffer":
        """Raises RolloutBufferError where the bytes are no rollout buffer, a truncated one, or one with a value
        of a video that is no number."""
        try:
            tensors: dict[str, Tensor] = load(data)
            header = json.loads(metadata_of(data)[_METADATA_KEY])
            rollout = {name: tensors[f"rollout.{name}"] for name in _ROLLOUT_TENSORS}
            for name, values in tensors.items():
                if name.startswith("condition.") or name.removeprefix("rollout.") in ROWS:
                    _check_finite(name, values)
            rewards = sorted(name for name in tensors if name.startswith("reward."))
            return cls(
                rollout=VideoRollout(**rollout, steps=tuple(header["steps"])),
                condition=Condition(
                    tensors["condition.frames"], tensors["condition.actions"], tensors["condition.text"]
                ),
                group_ids=tensors["group_ids"],
                sample_ids=tensors["sample_ids"],
                rewards={name.removeprefix("reward."): tensors[name] for name in rewards},
                policy_version=header["policy_version"],
                iteration=header["iteration"],
                config_hash=header["config_hash"],
            )
        except (SafetensorError, KeyError, TypeError, json.JSONDecodeError, UnicodeDecodeError) as error:
            raise RolloutBufferError(
                f"these {len(data)} bytes are no complete rollout buffer ({error}); sample again"
            ) from error

    def _tensors(self) -> dict[str, Tensor]:
        tensors = {f"rollout.{name}": getattr(self.rollout, name) for name in _ROLLOUT_TENSORS}
        tensors |= {f"condition.{name}": getattr(self.condition, name) for name in ("frames", "actions", "text")}
        tensors |= {f"reward.{name}": value for name, value in self.rewards.items()}
        tensors |= {"group_ids": self.group_ids, "sample_ids": self.sample_ids}
        return {name: tensor.contiguous() for name, tensor in tensors.items()}


def _check_finite(name: str, values: Tensor) -> None:
    if not bool(torch.isfinite(values).all()):
        video = int((~torch.isfinite(values)).flatten(1).any(1).nonzero()[0])
        raise RolloutBufferError(
            f"video {video} of the buffer has a value in {name} that is no number; lower the learning rate, or begin "
            "with other weights"
        )
