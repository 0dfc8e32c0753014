"""The loss of the done signal (RS-3). Shapes: E episodes, B of them, T steps, K done heads, J tasks."""

import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.core.seeding import torch_stream
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes

BOOTSTRAP_SHARE = 0.7
"""Each done head learns from its own random share of the episodes, so that heads disagree where data are thin."""


def done_mask(data: LatentEpisodes, index: Tensor, mask_BT: Tensor, head_mask_BK: Tensor) -> Tensor:
    """(B, T, K, J): 1 where head k learns task j's label of a frame of the episodes `index`; see rollout_losses."""
    return mask_BT[:, :, None, None] * head_mask_BK[:, None, :, None] * data.labelled[index][:, None, None]


def done_losses(logits_BTKJ: Tensor, labels_BTJ: Tensor, mask_BTKJ: Tensor) -> Tensor:
    """Mean binary cross-entropy (RS-3) where the mask is 1, nats."""
    labels, weight = labels_BTJ.unsqueeze(2).expand_as(logits_BTKJ), mask_BTKJ.expand_as(logits_BTKJ)
    entropy = F.binary_cross_entropy_with_logits(logits_BTKJ, labels, reduction="none")
    return (entropy * weight).sum() / weight.sum().clamp_min(1)


def bootstrap_masks(num_episodes: int, num_heads: int, seed: int) -> Tensor:
    """Float (E, K), 1 where head k learns from episode e; with one head every episode counts."""
    if num_heads == 1:
        return torch.ones(num_episodes, 1)
    return (torch.rand(num_episodes, num_heads, generator=torch_stream(seed, "bootstrap")) < BOOTSTRAP_SHARE).float()
