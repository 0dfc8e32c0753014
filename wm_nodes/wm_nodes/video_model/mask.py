"""Where a video moves: the dynamics-aware exploration mask of DynDiff-GRPO, DD-6 to DD-9b.

Shapes: B batch, C channels, F latent frames, H W latent grid. The mask is (B, 1, F, H, W), broadcast over channels.
Everything is computed without gradient from the clean estimate x0 of the same forward pass.
"""

import torch
from torch import Tensor
from torch.nn.functional import pad

from wm_nodes.config.video import MaskConfig

STATIC_SHARE = 1e-6
"""A video whose largest residual is below this share of its rms counts as still."""
_TINY = 1e-30
_LEAST_NORMAL = torch.finfo(torch.float32).tiny


@torch.no_grad()
def dynamic_mask(x0_BCFHW: Tensor, num_conditioning: int, settings: MaskConfig) -> Tensor:
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
    intensity = residual(x0, num_conditioning).square_().mean(1, keepdim=True).sqrt_()
    peak = intensity.flatten(1).amax(1)
    rms = torch.linalg.vector_norm(x0, dim=(1, 2, 3, 4)) / (C * F * H * W) ** 0.5
    still = (peak <= STATIC_SHARE * rms).float().view(-1, 1, 1, 1, 1)
    normalised = (intensity.reshape(B, -1) / peak.clamp_min(_TINY).unsqueeze(1)).reshape(intensity.shape)
    threshold = quantile(normalised.flatten(1), settings.quantile)
    threshold = threshold.clamp_min(_LEAST_NORMAL)  # one of 0 would call still cells dynamic
    prior = torch.ge(normalised, threshold.view(-1, 1, 1, 1, 1), out=torch.empty_like(normalised))
    level = prior.clone() if settings.combine == "sparse" else normalised * prior
    mask = level.mul_(1 - settings.m_min).add_(settings.m_min)
    if settings.budget == "rms":
        mask = mask / mask.square().mean((1, 2, 3, 4), keepdim=True).sqrt().clamp_min(_TINY)
    mask.mul_(1 - still).add_(still)  # 1 where the video is still
    return pad(mask, (0, 0, 0, 0, num_conditioning, 0))


def residual(x0_BCFHW: Tensor, num_conditioning: int = 0) -> Tensor:
    """Return r of DD-6 for the frames after the conditioning ones: temporal difference less its mean over the frame.

    A first frame has no predecessor and takes the second one's residual. The spatial mean removes a change of global
    brightness; a pan over a textured scene still lights up the whole frame.
    """
    seen = x0_BCFHW[:, :, max(0, num_conditioning - 1) :]
    change = seen[:, :, 1:] - seen[:, :, :-1]
    if num_conditioning == 0:
        change = torch.cat([change[:, :, :1], change], 2)
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
