"""Where a video moves: the dynamics-aware exploration mask of DynDiff-GRPO, DD-6 to DD-9b.

Shapes: B batch, C channels, F latent frames, H W latent grid. The mask is (B, 1, F, H, W), broadcast over channels.
Everything is computed without gradient from the clean estimate x0 of the same forward pass.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

STATIC_SHARE = 1e-6
"""A video whose largest residual is below this share of its rms counts as still."""
_TINY = 1e-30
_LEAST_NORMAL = torch.finfo(torch.float32).tiny


@dataclass(frozen=True)
class MaskSettings:
    """Of the mask; config/video.py explains them one by one. m_min is in (0, 1]."""

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
    """Return the mask M of DD-9, budgeted by DD-9b: 0 on conditioning frames, positive on generated ones.

    Args:
        x0_BCFHW: clean estimate with the *clean* conditioning frames already put in (DD-6 is wrong without).
        num_conditioning: leading frames that are given, 0 to F.

    It runs at every step of a rollout, so it makes few passes, and none over booleans, which are slow.
    """
    B, C, F, H, W = x0_BCFHW.shape
    if F == 1 or num_conditioning >= F:
        ones = x0_BCFHW.new_ones((B, 1, F, H, W), dtype=torch.float32)
        ones[:, :, :num_conditioning] = 0
        return ones
    x0 = x0_BCFHW.float()
    intensity = _channel_norm(residual(x0, settings.diff, num_conditioning), settings.channel_norm)
    peak = intensity.flatten(1).amax(1)
    rms = torch.linalg.vector_norm(x0, dim=(1, 2, 3, 4)) / (C * F * H * W) ** 0.5
    still = _rows((peak <= STATIC_SHARE * rms).float())
    normalised = _normalise(intensity, peak, settings)
    threshold = quantile(normalised.flatten(1), settings.quantile)
    threshold = threshold.clamp_min(_LEAST_NORMAL)  # one of 0 would call still cells dynamic
    prior = torch.ge(normalised, _rows(threshold), out=torch.empty_like(normalised))
    mask = _budget(_combine(normalised, prior, settings), prior, settings.budget)
    mask.mul_(1 - still).add_(still)  # 1 where the video is still
    return pad(mask, (0, 0, 0, 0, num_conditioning, 0))


def residual(x0_BCFHW: Tensor, diff: str = "backward", num_conditioning: int = 0) -> Tensor:
    """Return r of DD-6 for the frames after the conditioning ones: temporal difference less its mean over the frame.

    A first frame has no predecessor and takes the second one's residual. The spatial mean removes a change of global
    brightness; a pan over a textured scene still lights up the whole frame.
    """
    seen = x0_BCFHW[:, :, max(0, num_conditioning - 1) :]
    change = seen[:, :, 1:] - seen[:, :, :-1]
    if num_conditioning == 0:
        change = torch.cat([change[:, :, :1], change], 2)
    if diff == "central":
        forward = torch.cat([change[:, :, 1:], change[:, :, -1:]], 2)
        change = (change + forward) / 2
    return change.sub_(change.mean((3, 4), keepdim=True))


def quantile(values_BU: Tensor, q: float) -> Tensor:
    """Return the linearly interpolated q-quantile of each row of float32 values >= 0, (B,).

    Unlike torch.quantile without a size limit. One partial sort gives both neighbours of the position, and it compares
    integers, because the bits of floats >= 0 have the order of their values: a third of the time of two kthvalue.
    """
    U = values_BU.shape[1]
    position = q * (U - 1)
    below = int(position)
    upper = values_BU.view(torch.int32).topk(U - below, 1, sorted=False).values
    neighbours = upper.topk(min(2, U - below), 1, largest=False).values.view(torch.float32)
    low, high = neighbours[:, 0], neighbours[:, -1]
    return low if position == below else low + (position - below) * (high - low)


def _channel_norm(residual_BCFHW: Tensor, kind: str) -> Tensor:
    """DD-7, in place of the residual."""
    if kind == "rms":
        return residual_BCFHW.square_().mean(1, keepdim=True).sqrt_()
    magnitude = residual_BCFHW.abs_()
    return magnitude.mean(1, keepdim=True) if kind == "l1" else magnitude.amax(1, keepdim=True)


def _normalise(intensity: Tensor, peak_B: Tensor, settings: MaskSettings) -> Tensor:
    B, _, F, _, _ = intensity.shape
    whole = settings.norm_scope == "sample"
    rows = intensity.reshape(B if whole else B * F, -1)
    if settings.norm == "q99":
        normalised = (rows / _divisor(quantile(rows, 0.99))).clamp_max_(1.0)
    else:
        normalised = rows / _divisor(peak_B if whole else rows.amax(1))
    return normalised.reshape(intensity.shape)


def _divisor(scale_R: Tensor) -> Tensor:
    return scale_R.clamp_min(_TINY).unsqueeze(1)


def _combine(intensity: Tensor, prior: Tensor, settings: MaskSettings) -> Tensor:
    floor, share = settings.m_min, settings.convex_share
    if settings.combine == "max":
        return (intensity * prior).clamp_min(floor)
    if settings.combine == "gated":
        level = intensity * prior
    else:
        level = prior.clone() if settings.combine == "sparse" else share * intensity + (1 - share) * prior
    return level.mul_(1 - floor).add_(floor)


def _budget(mask: Tensor, prior: Tensor, budget: str) -> Tensor:
    if budget == "literal":
        return mask
    dims = (1, 2, 3, 4)
    if budget == "rms":
        mean_square = mask.square().mean(dims, keepdim=True)
    else:
        mean_square = (mask.square() * prior).sum(dims, keepdim=True) / prior.sum(dims, keepdim=True).clamp_min(1)
    return mask / mean_square.sqrt().clamp_min(_TINY)


def _rows(values_B: Tensor) -> Tensor:
    return values_B.view(-1, 1, 1, 1, 1)
