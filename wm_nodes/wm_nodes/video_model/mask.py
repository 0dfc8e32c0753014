"""Where a video moves: the dynamics-aware exploration mask of DynDiff-GRPO, equations (6) to (9b).

Shapes: B batch, C channels, F latent frames, H W latent grid. The mask is (B, 1, F, H, W), broadcast over channels.
Everything is computed without gradient from the clean estimate x0 of the same forward pass.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

STATIC_SHARE = 1e-6
"""A video whose largest residual is below this share of its rms counts as still."""
_TINY = 1e-30


@dataclass(frozen=True)
class MaskSettings:
    """Knobs of the mask.

    m_min: exploration left where nothing moves, in (0, 1]; a cell without any has no density.
    quantile: q of (8); cells whose intensity reaches it count as dynamic.
    combine: how intensity I and sparse prior P become the mask (9). gated: m_min + (1 - m_min) I P, the paper's
        reading; sparse: m_min + (1 - m_min) P; convex: m_min + (1 - m_min)(a I + (1 - a) P); max: max(m_min, I P).
    convex_share: a of `convex`.
    channel_norm: how a residual's channels become one intensity (7).
    norm: what an intensity is divided by; q99 is the 0.99 quantile, less sensitive to one hot cell.
    norm_scope: over the whole sample, or per frame (gives still frames full exploration).
    diff: temporal difference of (6).
    budget: (9b) literal: as is; rms: the mask's mean square over generated cells becomes 1; peak: its mean square over
        dynamic cells does.
    time_limit: above this t the mask is 1 everywhere (x0 says little about motion near pure noise).
    """

    m_min: float = 0.2
    quantile: float = 0.8
    combine: Literal["gated", "sparse", "convex", "max"] = "gated"
    convex_share: float = 0.5
    channel_norm: Literal["rms", "l1", "max"] = "rms"
    norm: Literal["max", "q99"] = "max"
    norm_scope: Literal["sample", "frame"] = "sample"
    diff: Literal["backward", "central"] = "backward"
    budget: Literal["literal", "rms", "peak"] = "literal"
    time_limit: float = 1.0

    def __post_init__(self) -> None:
        for name in ("m_min", "quantile", "convex_share"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {value}")
        if self.m_min == 0:
            raise ValueError("m_min must be > 0: a cell without noise has no density; take 0.05 for very little")


@torch.no_grad()
def dynamic_mask(x0_BCFHW: Tensor, num_conditioning: int, settings: MaskSettings) -> Tensor:
    """Return the mask M of (9), budgeted by (9b): 0 on conditioning frames, positive on generated ones.

    Args:
        x0_BCFHW: clean estimate with the *clean* conditioning frames already put in (equation (6) is wrong without).
        num_conditioning: leading frames that are given, 0 to F.
    """
    B, _, F, H, W = x0_BCFHW.shape
    ones = x0_BCFHW.new_ones((B, 1, F, H, W), dtype=torch.float32)
    ones[:, :, :num_conditioning] = 0
    if F == 1 or num_conditioning >= F:
        return ones
    intensity = _channel_norm(residual(x0_BCFHW.float(), settings.diff), settings.channel_norm)
    generated = intensity[:, :, num_conditioning:]
    normalised = _normalise(generated, settings)
    threshold = quantile(normalised.flatten(1), settings.quantile).view(-1, 1, 1, 1, 1)
    prior = ((normalised >= threshold) & (normalised > 0)).float()  # a threshold of 0 would call still cells dynamic
    mask = _budget(_combine(normalised, prior, settings), prior, settings.budget)
    still = generated.flatten(1).amax(1) <= STATIC_SHARE * x0_BCFHW.float().square().mean((1, 2, 3, 4)).sqrt()
    ones[:, :, num_conditioning:] = torch.where(still.view(-1, 1, 1, 1, 1), 1.0, mask)
    return ones


def residual(x0_BCFHW: Tensor, diff: str = "backward") -> Tensor:
    """Return r of (6), shape as x0: the temporal difference less its mean over each frame.

    The first frame has no predecessor and takes the second one's residual. The spatial mean removes a change of global
    brightness; a pan over a textured scene still lights up the whole frame.
    """
    backward = x0_BCFHW[:, :, 1:] - x0_BCFHW[:, :, :-1]
    change = torch.cat([backward[:, :, :1], backward], 2)
    if diff == "central":
        forward = torch.cat([backward, backward[:, :, -1:]], 2)
        change = (change + forward) / 2
    return change - change.mean((3, 4), keepdim=True)


def quantile(values_BU: Tensor, q: float) -> Tensor:
    """Return the linearly interpolated q-quantile of each row, (B,); unlike torch.quantile without a size limit."""
    position = q * (values_BU.shape[1] - 1)
    below = int(position)
    low = values_BU.kthvalue(below + 1, 1).values
    if position == below:
        return low
    high = values_BU.kthvalue(below + 2, 1).values
    return low + (position - below) * (high - low)


def _channel_norm(residual_BCFHW: Tensor, kind: str) -> Tensor:
    if kind == "rms":
        return residual_BCFHW.square().mean(1, keepdim=True).sqrt()
    if kind == "l1":
        return residual_BCFHW.abs().mean(1, keepdim=True)
    return residual_BCFHW.abs().amax(1, keepdim=True)


def _normalise(intensity: Tensor, settings: MaskSettings) -> Tensor:
    B, _, F, _, _ = intensity.shape
    rows = intensity.reshape(B, -1) if settings.norm_scope == "sample" else intensity.reshape(B * F, -1)
    scale = rows.amax(1) if settings.norm == "max" else quantile(rows, 0.99)
    normalised = (rows / scale.clamp_min(_TINY).unsqueeze(1)).clamp_max(1.0)
    return normalised.reshape(intensity.shape)


def _combine(intensity: Tensor, prior: Tensor, settings: MaskSettings) -> Tensor:
    floor, share = settings.m_min, settings.convex_share
    if settings.combine == "max":
        return (intensity * prior).clamp_min(floor)
    level = {
        "gated": intensity * prior,
        "sparse": prior,
        "convex": share * intensity + (1 - share) * prior,
    }[settings.combine]
    return floor + (1 - floor) * level


def _budget(mask: Tensor, prior: Tensor, budget: str) -> Tensor:
    if budget == "literal":
        return mask
    weight = prior if budget == "peak" else torch.ones_like(prior)
    mean_square = (mask.square() * weight).sum((1, 2, 3, 4), keepdim=True) / weight.sum((1, 2, 3, 4), keepdim=True)
    return mask / mean_square.sqrt().clamp_min(_TINY)
