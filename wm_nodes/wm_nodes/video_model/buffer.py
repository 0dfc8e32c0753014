"""The rollout buffer of GRPO: sampled groups, their rewards, and everything a training step needs.

Shapes: N videos, S stochastic steps. The file is one safetensors; nothing in it is executed on load.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from wm_nodes.config.video import RolloutConfig
from wm_nodes.training.checkpoint import metadata_of, section
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.sampling import ROWS, VideoRollout

_METADATA_KEY = "rollout_buffer"
_HEADER = ("policy_version", "iteration", "config_hash")


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
    """Raw values by name, float64 (N,), NaN where missing; `total` trains."""
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
        """The reward that trains, float64 (N,): `total`. Raises ValueError where there is none."""
        if "total" not in self.rewards:
            raise ValueError(
                f"the buffer holds rewards {', '.join(self.rewards) or '(none)'} and no `total`; mix them first"
            )
        return self.rewards["total"]

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
        header = {"steps": self.rollout.steps, **{name: getattr(self, name) for name in _HEADER}}
        # safetensors refuses memory under two names, e.g. a total of one reward
        parts: dict[str, Mapping[str, Any]] = {
            "rollout": vars(self.rollout), "condition": vars(self.condition),
            "reward": {name: value.clone() for name, value in self.rewards.items()},
        }
        tensors = {
            f"{part}.{name}": value.cpu().contiguous()
            for part, values in parts.items() for name, value in values.items() if isinstance(value, Tensor)
        }
        ids = {"group_ids": self.group_ids, "sample_ids": self.sample_ids.clone()}
        data: bytes = save({**tensors, **ids}, {_METADATA_KEY: json.dumps(header)})
        return data

    @classmethod
    def from_bytes(cls, data: bytes) -> "RolloutBuffer":
        """Raises RolloutBufferError where the bytes are no rollout buffer, a truncated one, or one with a value
        of a video that is no number."""
        try:
            tensors: dict[str, Tensor] = load(data)
            header = json.loads(metadata_of(data)[_METADATA_KEY])
            for name, values in tensors.items():
                if name.startswith("condition.") or name.removeprefix("rollout.") in ROWS:
                    finite = torch.isfinite(values).flatten(1).all(1)
                    if not finite.all():
                        raise RolloutBufferError(
                            f"video {int(finite.int().argmin())} of the buffer has a value in {name} that is no "
                            "number; lower the learning rate, or begin with other weights"
                        )
            return cls(
                VideoRollout(**section(tensors, "rollout."), steps=tuple(header["steps"])),
                Condition(**section(tensors, "condition.")), tensors["group_ids"], tensors["sample_ids"],
                dict(sorted(section(tensors, "reward.").items())), **{name: header[name] for name in _HEADER},
            )
        except (SafetensorError, KeyError, TypeError, json.JSONDecodeError, UnicodeDecodeError) as error:
            raise RolloutBufferError(
                f"these {len(data)} bytes are no complete rollout buffer ({error}); sample again"
            ) from error
