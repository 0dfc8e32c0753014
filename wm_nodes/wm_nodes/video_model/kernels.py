"""One step of every sampler: the Gaussian of x_s given x_t = x and the velocity v (DD-3 to DD-5, DD-10,
DD-11), and that of the rival samplers (DD-21 to DD-24).

Shapes: B batch, C channels, F latent frames, H W latent grid; t, s: float64 (B,), with 1 >= t > s >= 0.
Every kernel returns mean and standard deviation; std is 0 (an ODE step) where s = 0. Coefficients are computed in
float64 and cast to the dtype of x; no gradient reaches the standard deviation or the mask.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from wm_nodes.video_model.mask import MaskSettings, dynamic_mask

Arm = Literal["ode", "cps", "dyndiff", "flow", "dance", "sage"]

SIGMA_LIMIT = 1 - 1e-3
"""sigma <= SIGMA_LIMIT * s where a noise budget raises the mask above 1: sqrt(s^2 - sigma^2) stays off its kink."""
SAGE_LATEST = 0.997
"""t~ of SAGE's first step."""


@dataclass(frozen=True)
class SamplerSettings:
    """What decides the Gaussian of a step.

    arm: ode | cps | dyndiff | flow (Flow-GRPO) | dance (DanceGRPO) | sage (SAGE-GRPO).
    eta: noise level; in [0, 1] for cps and dyndiff (the sine map folds beyond), >= 0 for the others.
    sigma_map: sigma_base = s sin(pi eta / 2), or eta s.
    mask: dyndiff only. mask_on: what the mask scales, the standard deviation, its square, or eta.
    mask_dtype: the mask is rounded to it before it is used, so that a stored mask is the used one.
    """

    arm: Arm = "dyndiff"
    eta: float = 0.6
    sigma_map: Literal["sin", "linear"] = "sin"
    mask: MaskSettings = field(default_factory=MaskSettings)
    mask_on: Literal["std", "var", "eta"] = "std"
    mask_dtype: Literal["float32", "float16"] = "float32"

    def __post_init__(self) -> None:
        if self.arm not in KERNELS:
            raise ValueError(f"arm must be one of {', '.join(sorted(KERNELS))}, got {self.arm!r}")
        high = 1.0 if self.arm in ("cps", "dyndiff") else math.inf
        if not 0 <= self.eta <= high:
            raise ValueError(f"eta must be in [0, {high:g}] for {self.arm}, got {self.eta}")


@dataclass(frozen=True)
class StepContext:
    """What a kernel may need beside x, v, t and s.

    conditioning: clean leading frames (B, C, K, H, W), K may be 0. first_time: t_1, for Flow-GRPO's first step.
    mask: the mask cached at rollout (B, 1, F, H, W); None: computed from this step's clean estimate.
    """

    conditioning: Tensor
    first_time: float
    mask: Tensor | None = None

    @property
    def num_conditioning(self) -> int:
        return self.conditioning.shape[2]


class Step(NamedTuple):
    """mean: like x. std: (B, 1, F, H, W), 0 on conditioning frames. sigma_base: (B,), the std where the mask is 1.
    mask: (B, 1, F, H, W), 0 on conditioning frames. slope: d mean / d v of each element, (B, 1, F, H, W) or
    (B, 1, 1, 1, 1).
    """

    mean: Tensor
    std: Tensor
    sigma_base: Tensor
    mask: Tensor
    slope: Tensor


Kernel = Callable[[Tensor, Tensor, Tensor, Tensor, StepContext, SamplerSettings], Step]


def step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerSettings) -> Step:
    """Return the Gaussian of x_s given x_t = x and the velocity v, by the arm of the settings."""
    return KERNELS[settings.arm](x, v, t, s, context, settings)


def estimates(x: Tensor, v: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return DD-3: the clean estimate x0 = x - t v and the noise estimate eps = x + (1 - t) v."""
    return x - _rows(t, x) * v, x + _rows(1 - t, x) * v


def with_conditioning(x: Tensor, conditioning: Tensor) -> Tensor:
    """Return x with its leading frames overwritten by the clean ones."""
    K = conditioning.shape[2]
    return x if K == 0 else torch.cat([conditioning.to(x.dtype), x[:, :, K:]], 2)


def ode_step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerSettings) -> Step:
    """The Euler step x + (s - t) v."""
    still = _generated(x, context)
    slope = _rows(s - t, x)
    return Step(x + slope * v, torch.zeros_like(still), torch.zeros_like(slope).flatten(), still, slope)


def cps_step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerSettings) -> Step:
    """Coefficient-preserving sampling: DD-4 with the same sigma in every cell."""
    return _preserving_step(*estimates(x, v, t), t, s, _generated(x, context), settings)


def dyndiff_step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerSettings) -> Step:
    """DD-4 with the sigma of DD-5."""
    x0, eps = estimates(x, v, t)
    mask = context.mask
    if mask is None:
        mask = rollout_mask(x0, t, context, settings)
    elif mask.shape != (x.shape[0], 1, *x.shape[2:]):
        expected = (x.shape[0], 1, *x.shape[2:])
        raise ValueError(f"mask must be {expected} for latents {tuple(x.shape)}, got {tuple(mask.shape)}")
    return _preserving_step(x0, eps, t, s, mask.to(x.dtype), settings)


@torch.no_grad()
def rollout_mask(x0: Tensor, t: Tensor, context: StepContext, settings: SamplerSettings) -> Tensor:
    """Return the mask of a step, (B, 1, F, H, W), from its clean estimate: DD-9 up to time_limit, 1 above; rounded."""
    mask = dynamic_mask(with_conditioning(x0, context.conditioning), context.num_conditioning, settings.mask)
    if settings.mask.time_limit < 1:
        late = (t <= settings.mask.time_limit).view(-1, 1, 1, 1, 1).to(mask.device)
        mask = torch.where(late, mask, _generated(x0, context).to(mask.dtype))
    return mask.to(getattr(torch, settings.mask_dtype)).to(x0.dtype)


def _preserving_step(x0: Tensor, eps: Tensor, t: Tensor, s: Tensor, mask: Tensor, settings: SamplerSettings) -> Step:
    """DD-10, DD-11: mean (1 - s) x0 + sqrt(s^2 - sigma^2) eps; the squared noise coefficients add up to s^2."""
    with torch.no_grad():
        base, sigma = _rows(_sigma_base(s, settings.eta, settings.sigma_map), x0), masked_deviation(mask, s, settings)
        kept = (_rows(s, x0).square() - sigma.square()).clamp_min(0).sqrt()
        slope = _rows(1 - t, x0) * kept - _rows((1 - s) * t, x0)
    return Step(_rows(1 - s, x0) * x0 + kept * eps, sigma, base.flatten(), mask, slope)


def masked_deviation(mask: Tensor, s: Tensor, settings: SamplerSettings) -> Tensor:
    """Return sigma of DD-5, (B, 1, F, H, W), in the dtype of the mask."""
    base, s_rows = _rows(_sigma_base(s, settings.eta, settings.sigma_map), mask), _rows(s, mask)
    if settings.mask_on == "std":
        sigma = base * mask
    elif settings.mask_on == "var":
        sigma = base * mask.sqrt()
    else:
        angle = settings.eta * mask
        sigma = s_rows * (torch.sin(angle.clamp_max(1.0) * (math.pi / 2)) if settings.sigma_map == "sin" else angle)
    return torch.where(mask > 1, torch.minimum(sigma, SIGMA_LIMIT * s_rows), sigma)


def _euler_sde(x: Tensor, v: Tensor, t: Tensor, s: Tensor, variance: Tensor, context: StepContext) -> Step:
    """mean x + (s - t) v - Sigma^2 / (2 t) eps, std Sigma: the common form of Flow-GRPO, DanceGRPO and SAGE (DD-21)."""
    _, eps = estimates(x, v, t)
    variance = torch.where(s > 0, variance, 0.0)
    std = _rows(variance.sqrt(), x)
    mean = x + _rows(s - t, x) * v - _rows(variance / (2 * t), x) * eps
    generated = _generated(x, context)
    slope = _rows((s - t) - variance * (1 - t) / (2 * t), x)
    return Step(mean, std * generated, std.flatten(), generated, slope)


def flow_step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerSettings) -> Step:
    """Flow-GRPO (DD-22): Sigma^2 = a^2 t / (1 - t~) (t - s), t~ = t_1 at the first step (in the denominator only)."""
    denominator = 1 - torch.where(t >= 1, torch.full_like(t, context.first_time), t)
    return _euler_sde(x, v, t, s, settings.eta**2 * t / denominator * (t - s), context)


def dance_step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerSettings) -> Step:
    """DanceGRPO (DD-23): Sigma^2 = eta^2 (t - s)."""
    return _euler_sde(x, v, t, s, settings.eta**2 * (t - s), context)


def sage_step(x: Tensor, v: Tensor, t: Tensor, s: Tensor, context: StepContext, settings: SamplerSettings) -> Step:
    """SAGE (DD-24): Sigma^2 = eta^2 (ln((1 - s) / (1 - t~)) - (t - s)), t~ = min(t, 0.997).

    Up to t = 0.997 this is the integral of eta^2 tau / (1 - tau) from s to t.
    """
    variance = settings.eta**2 * (torch.log((1 - s) / (1 - t.clamp_max(SAGE_LATEST))) - (t - s))
    return _euler_sde(x, v, t, s, variance.clamp_min(0), context)


KERNELS: dict[str, Kernel] = {
    "ode": ode_step,
    "cps": cps_step,
    "dyndiff": dyndiff_step,
    "flow": flow_step,
    "dance": dance_step,
    "sage": sage_step,
}


def _sigma_base(s: Tensor, eta: float, sigma_map: str) -> Tensor:
    return s * (math.sin(math.pi * eta / 2) if sigma_map == "sin" else eta)


def _generated(x: Tensor, context: StepContext) -> Tensor:
    """1 on generated frames, 0 on conditioning frames, (B, 1, F, H, W)."""
    ones = x.new_ones((x.shape[0], 1, *x.shape[2:]))
    ones[:, :, : context.num_conditioning] = 0
    return ones


def _rows(values_B: Tensor, like: Tensor) -> Tensor:
    return values_B.to(device=like.device, dtype=like.dtype).view(-1, 1, 1, 1, 1)
