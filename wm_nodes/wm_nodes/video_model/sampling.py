"""Algorithm 1, rollout half: sample videos and keep what training needs. Section 1.8.

Shapes: N videos, S stochastic steps, L kept latents, C channels, F latent frames, H W grid, K given frames.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from wm_nodes.seeding import torch_stream
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import SamplerSettings, Step, StepContext, ode_step, step, with_conditioning
from wm_nodes.video_model.network import VelocityModel, guided_velocity
from wm_nodes.video_model.schedule import flow_times


@dataclass(frozen=True)
class RolloutSettings:
    """How videos are sampled.

    cfg: guidance g of v_u + g (v_c - v_u); 1 is off. storage_dtype: of the kept latents; x_s is rounded to it before
    its log-probability is taken. noise_store: keep the normalised noise of each step (exact, as large as the latents),
    or only the seed it was drawn from (no memory; needs float32 latents). micro_batch: videos per network call.
    """

    num_steps: int = 10
    shift: float = 1.0
    cfg: float = 1.0
    sampler: SamplerSettings = field(default_factory=SamplerSettings)
    storage_dtype: Literal["float32", "bfloat16"] = "float32"
    noise_store: Literal["zeta", "seed"] = "zeta"
    micro_batch: int = 16

    def __post_init__(self) -> None:
        if self.noise_store == "seed" and self.storage_dtype != "float32":
            raise ValueError(
                "noise_store seed needs storage_dtype float32: what rounding x_s changes cannot be drawn again"
            )
        if self.micro_batch < 1:
            raise ValueError(f"micro_batch must be >= 1, got {self.micro_batch}")

    @property
    def times(self) -> Tensor:
        return flow_times(self.num_steps, self.shift)

    def trains_at(self, k: int) -> bool:
        """Whether step k can have a density: it has noise, and does not end in clean data."""
        return 0 <= k < self.num_steps - 1 and self.sampler.arm != "ode" and self.sampler.eta > 0


@dataclass(frozen=True)
class VideoRollout:
    """N sampled videos and the transitions that can be trained on.

    latents: the clean result (N, C, F, H, W), float32. steps: the stochastic steps k, ascending. states: x at the steps
    of state_steps (N, L, C, F, H, W); transition k leads from state k to state k + 1. mask: (N, S, 1, F, H, W).
    sigma_base: (N, S). zeta: (N, S, C, F - K, H, W), or None where only seeds are kept. seeds: int64 (N,).
    noise_share: rms of std / s over generated elements, (S,), the noise budget that was spent.
    """

    latents: Tensor
    steps: tuple[int, ...]
    state_steps: tuple[int, ...]
    states: Tensor
    mask: Tensor
    sigma_base: Tensor
    zeta: Tensor | None
    seeds: Tensor
    noise_share: Tensor

    @property
    def spent_noise(self) -> float:
        """Root mean square of noise_share over the stochastic steps; 0 by ODE."""
        return float(self.noise_share.square().mean().sqrt()) if len(self.noise_share) else 0.0

    def state(self, k: int) -> Tensor:
        """x before step k, (N, C, F, H, W), storage dtype."""
        return self.states[:, self.state_steps.index(k)]


def initial_noise(shape: tuple[int, ...], seeds: Tensor) -> Tensor:
    """Return x at t = 1, float32 (N, *shape), row i drawn from seeds[i]; equal seeds give shared initial noise."""
    return torch.stack([torch.randn(shape, generator=torch_stream(int(seed), "initial_noise")) for seed in seeds])


def step_noise(shape: tuple[int, ...], seeds: Tensor, k: int) -> Tensor:
    """Return the fresh noise z of step k, float32 (N, *shape), row i from seeds[i]."""
    return torch.stack([torch.randn(shape, generator=torch_stream(int(seed), "step_noise", k)) for seed in seeds])


@torch.no_grad()
def sample_videos(
    model: VelocityModel,
    condition: Condition,
    noise: Tensor,
    seeds: Tensor,
    settings: RolloutSettings,
    stochastic: list[int] | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> VideoRollout:
    """Sample one video per row of `noise` (N, C, F, H, W), stochastic at the given steps, by ODE elsewhere.

    Args:
        seeds: int64 (N,), of each video's step noise.
        stochastic: None: every step but the last. Empty: the ODE.
        on_progress: called with (videos sampled, of how many) after every micro-batch; may raise to stop.

    Raises:
        ValueError: a step that cannot be stochastic.
    """
    chosen = list(range(settings.num_steps - 1)) if stochastic is None else sorted(set(stochastic))
    outside = [k for k in chosen if not 0 <= k < settings.num_steps - 1]
    if outside:
        raise ValueError(
            f"steps {outside} cannot be stochastic; of {settings.num_steps} steps all but the last, 0 to "
            f"{settings.num_steps - 2}, can"
        )
    chosen = [k for k in chosen if settings.trains_at(k)]
    batches = (slice(i, i + settings.micro_batch) for i in range(0, len(noise), settings.micro_batch))
    parts = list[VideoRollout]()
    for rows in batches:
        parts.append(_sample(model, condition.rows(rows), noise[rows], seeds[rows], settings, chosen))
        on_progress(min(rows.stop, len(noise)), len(noise))
    return concatenate_rollouts(parts)


def concatenate_rollouts(parts: list[VideoRollout]) -> VideoRollout:
    """The videos of all parts, which were sampled with the same steps."""
    total = sum(len(part.latents) for part in parts)
    squares = torch.stack([part.noise_share.square() * (len(part.latents) / total) for part in parts])
    return VideoRollout(
        latents=torch.cat([part.latents for part in parts]),
        steps=parts[0].steps,
        state_steps=parts[0].state_steps,
        states=torch.cat([part.states for part in parts]),
        mask=torch.cat([part.mask for part in parts]),
        sigma_base=torch.cat([part.sigma_base for part in parts]),
        zeta=None if parts[0].zeta is None else torch.cat([part.zeta for part in parts if part.zeta is not None]),
        seeds=torch.cat([part.seeds for part in parts]),
        noise_share=squares.sum(0).sqrt(),
    )


def _sample(
    model: VelocityModel,
    condition: Condition,
    noise: Tensor,
    seeds: Tensor,
    settings: RolloutSettings,
    stochastic: list[int],
) -> VideoRollout:
    times, N, K = settings.times, len(noise), condition.num_conditioning
    storage = getattr(torch, settings.storage_dtype)
    context = StepContext(condition.frames.float(), first_time=float(times[1]))
    state_steps = tuple(sorted({*stochastic, *(k + 1 for k in stochastic)}))
    x = with_conditioning(noise.float(), context.conditioning)
    states, masks, bases, zetas, shares = [], [], [], [], []
    for k in range(settings.num_steps):
        if k in state_steps:
            x = with_conditioning(x.to(storage).float(), context.conditioning)
            states.append(x.to(storage))
        t, s = times[k].expand(N), times[k + 1].expand(N)
        v = guided_velocity(model, x, t, condition, settings.cfg).float()
        if k not in stochastic:
            x = with_conditioning(ode_step(x, v, t, s, context, settings.sampler).mean, context.conditioning)
            continue
        law = step(x, v, t, s, context, settings.sampler)
        z = step_noise(tuple(x.shape[1:]), seeds, k).to(x.device)
        x = with_conditioning((law.mean + law.std * z).to(storage).float(), context.conditioning)
        masks.append(law.mask)
        bases.append(law.sigma_base)
        spent = (law.std[:, :, K:] / float(times[k + 1])).square()
        shares.append((spent.sum() / max(1, spent.numel())).sqrt())
        if settings.noise_store == "zeta":
            zetas.append(normalised_noise(x, law, K))
    empty = x.new_zeros(N, 0)
    return VideoRollout(
        latents=x,
        steps=tuple(stochastic),
        state_steps=state_steps,
        states=torch.stack(states, 1) if states else empty,
        mask=torch.stack(masks, 1) if masks else empty,
        sigma_base=torch.stack(bases, 1) if bases else empty,
        zeta=None if settings.noise_store == "seed" else torch.stack(zetas, 1) if zetas else empty,
        seeds=seeds.clone(),
        noise_share=torch.stack(shares) if shares else x.new_zeros(0),
    )


def normalised_noise(x_s: Tensor, law: Step, num_conditioning: int) -> Tensor:
    """Return zeta = (x_s - mean) / std on generated frames, (N, C, F - K, H, W)."""
    K = num_conditioning
    return (x_s[:, :, K:] - law.mean[:, :, K:]) / law.std[:, :, K:]
