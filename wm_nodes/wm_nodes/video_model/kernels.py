"""One step of every sampler: the Gaussian of x_s given x_t = x and the velocity v (DD-3 to DD-5, DD-10,
DD-11), and that of the rival samplers (DD-21 to DD-24).

Shapes: B batch, C channels, F latent frames, H W latent grid; t, s: float64 (B,), with 1 >= t > s >= 0.
Every kernel returns mean and standard deviation; std is 0 (an ODE step) where s = 0. Coefficients are computed in
float64 and cast to the dtype of x; no gradient reaches the standard deviation or the mask.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from wm_nodes.config.video import SAGE_LATEST, SamplerConfig
from wm_nodes.video_model.mask import dynamic_mask

SIGMA_LIMIT = 1 - 1e-3
"""sigma <= SIGMA_LIMIT * s where a noise budget raises the mask above 1: sqrt(s^2 - sigma^2) stays off its kink."""


@dataclass(frozen=True)
class StepContext:
    """What a kernel may need beside x, v, t and s."""

    conditioning: Tensor
    """Clean leading frames (B, C, K, H, W); K may be 0."""
    first_time: float
    """t_1, for Flow-GRPO's first step."""
    mask: Tensor | None = None
    """The mask cached at rollout (B, 1, F, H, W); None: computed from this step's clean estimate."""

    @property
    def num_conditioning(self) -> int:
        return self.conditioning.shape[2]


class Step(NamedTuple):
    """The Gaussian of x_s."""

    mean: Tensor
    """Like x."""
    std: Tensor
    """(B, 1, F, H, W), 0 on conditioning frames."""
    mask: Tensor
    """(B, 1, F, H, W), 0 on conditioning frames."""


def step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerConfig) -> Step:
    """Return the Gaussian of x_s given x_t = x and the velocity v, by the arm of the settings.

    cps and dyndiff preserve coefficients (DD-4), with the same sigma in every cell, or that of DD-5.
    """
    if settings.arm == "ode":
        return ode_step(x, v, t, s, context)
    generated = _generated(x, context)
    if variance := VARIANCES.get(settings.arm):
        return _euler_sde(x, v, t, s, variance(t, s, settings.eta**2, context.first_time), generated)
    x0, eps = estimates(x, v, t)
    if settings.arm == "cps":
        return _preserving_step(x0, eps, s, generated, settings)
    mask = rollout_mask(x0, context, settings) if context.mask is None else context.mask
    if mask.shape != generated.shape:
        raise ValueError(f"mask must be {tuple(generated.shape)} for latents {tuple(x.shape)}, got {tuple(mask.shape)}")
    return _preserving_step(x0, eps, s, mask.to(x.dtype), settings)


def estimates(x: Tensor, v: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return DD-3: the clean estimate x0 = x - t v and the noise estimate eps = x + (1 - t) v."""
    return x - _rows(t, x) * v, x + _rows(1 - t, x) * v


def with_conditioning(x: Tensor, conditioning: Tensor) -> Tensor:
    """Return x with its leading frames overwritten by the clean ones."""
    K = conditioning.shape[2]
    return x if K == 0 else torch.cat([conditioning.to(x.dtype), x[:, :, K:]], 2)


def ode_step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext) -> Step:
    """The Euler step x + (s - t) v."""
    still = _generated(x, context)
    return Step(x + _rows(s - t, x) * v, torch.zeros_like(still), still)


@torch.no_grad()
def rollout_mask(x0: Tensor, context: StepContext, settings: SamplerConfig) -> Tensor:
    """Return the mask of a step (DD-9), (B, 1, F, H, W), from its clean estimate."""
    mask = dynamic_mask(with_conditioning(x0, context.conditioning), context.num_conditioning, settings.mask)
    return mask.to(x0.dtype)


def _preserving_step(x0: Tensor, eps: Tensor, s: Tensor, mask: Tensor, settings: SamplerConfig) -> Step:
    """DD-10, DD-11: mean (1 - s) x0 + sqrt(s^2 - sigma^2) eps; the squared noise coefficients add up to s^2."""
    with torch.no_grad():
        sigma = masked_deviation(mask, s, settings)
        kept = (_rows(s, x0).square() - sigma.square()).clamp_min(0).sqrt()
    return Step(_rows(1 - s, x0) * x0 + kept * eps, sigma, mask)


def masked_deviation(mask: Tensor, s: Tensor, settings: SamplerConfig) -> Tensor:
    """Return sigma of DD-5, (B, 1, F, H, W), in the dtype of the mask."""
    sigma = _rows(s * math.sin(math.pi * settings.eta / 2), mask) * mask
    return torch.where(mask > 1, torch.minimum(sigma, SIGMA_LIMIT * _rows(s, mask)), sigma)


def _euler_sde(x: Tensor, v: Tensor, t: Tensor, s: Tensor, variance: Tensor, generated: Tensor) -> Step:
    """mean x + (s - t) v - Sigma^2 / (2 t) eps, std Sigma: the common form of Flow-GRPO, DanceGRPO and SAGE (DD-21)."""
    _, eps = estimates(x, v, t)
    variance = torch.where(s > 0, variance, 0.0)
    mean = x + _rows(s - t, x) * v - _rows(variance / (2 * t), x) * eps
    return Step(mean, _rows(variance.sqrt(), x) * generated, generated)


def flow_variance(t: Tensor, s: Tensor, power: float, first_time: float) -> Tensor:
    """Flow-GRPO (DD-22): Sigma^2 = a^2 t / (1 - t~) (t - s), t~ = t_1 at the first step (in the denominator only)."""
    return power * t / (1 - torch.where(t >= 1, torch.full_like(t, first_time), t)) * (t - s)


def dance_variance(t: Tensor, s: Tensor, power: float, first_time: float) -> Tensor:
    """DanceGRPO (DD-23): Sigma^2 = eta^2 (t - s)."""
    return power * (t - s)


def sage_variance(t: Tensor, s: Tensor, power: float, first_time: float) -> Tensor:
    """SAGE (DD-24): Sigma^2 = eta^2 (ln((1 - s) / (1 - t~)) - (t - s)), t~ = min(t, 0.997).

    Up to t = 0.997 this is the integral of eta^2 tau / (1 - tau) from s to t.
    """
    return (power * (torch.log((1 - s) / (1 - t.clamp_max(SAGE_LATEST))) - (t - s))).clamp_min(0)


VARIANCES = {"flow": flow_variance, "dance": dance_variance, "sage": sage_variance}
"""(t, s, eta^2, first time) -> Sigma^2, (B,)."""


def _generated(x: Tensor, context: StepContext) -> Tensor:
    """1 on generated frames, 0 on conditioning frames, (B, 1, F, H, W)."""
    ones = x.new_ones((x.shape[0], 1, *x.shape[2:]))
    ones[:, :, : context.num_conditioning] = 0
    return ones


def _rows(values_B: Tensor, like: Tensor) -> Tensor:
    return values_B.to(device=like.device, dtype=like.dtype).view(-1, 1, 1, 1, 1)
