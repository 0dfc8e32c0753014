"""Sample videos and keep what training needs of them (DD-1, DD-14b).

Shapes: N videos, S stochastic steps, L kept latents, C channels, F latent frames, H W grid, K given frames.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from wm_nodes.config.video import RolloutConfig
from wm_nodes.core.seeding import torch_stream
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import Step, StepContext, ode_step, step, with_conditioning
from wm_nodes.video_model.network import VelocityModel, guided_velocity
from wm_nodes.video_model.schedule import flow_times

ROWS = ("latents", "states", "mask", "zeta")
"""Tensors of a VideoRollout that have a row per video."""


@dataclass(frozen=True)
class VideoRollout:
    """N sampled videos and the transitions that can be trained on."""

    latents: Tensor
    """The clean result (N, C, F, H, W), float32."""
    steps: tuple[int, ...]
    """The stochastic steps k, ascending."""
    states: Tensor
    """x before each of state_steps (N, L, C, F, H, W), float32 or bfloat16."""
    mask: Tensor
    """(N, S, 1, F, H, W)."""
    zeta: Tensor
    """Normalised noise (N, S, C, F - K, H, W), float32 or bfloat16."""
    noise_share: Tensor
    """rms of std / s over generated elements, (S,), the noise budget that was spent."""

    @property
    def state_steps(self) -> tuple[int, ...]:
        """Those of `states`; transition k leads from state k to state k + 1."""
        return tuple(sorted({*self.steps, *(k + 1 for k in self.steps)}))

    @property
    def spent_noise(self) -> float:
        """Root mean square of noise_share over the stochastic steps; 0 by ODE."""
        return float(self.noise_share.square().mean().sqrt()) if len(self.noise_share) else 0.0

    def rows(self, index: Tensor | slice) -> "VideoRollout":
        """Some of the videos, as views for a slice; noise_share is that of all."""
        return replace(self, **{name: getattr(self, name)[index] for name in ROWS})

    def to(self, device: torch.device | str) -> "VideoRollout":
        """The same videos on a device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in (*ROWS, "noise_share")})

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
    settings: RolloutConfig,
    stochastic: list[int] | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> VideoRollout:
    """Sample one video per row of `noise` (N, C, F, H, W), stochastic at the given steps, by ODE elsewhere.

    It computes where `noise` and `condition` are, with the model.

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
    if settings.is_ode:
        chosen = []
    rollout = _unsampled(noise, condition.num_conditioning, settings, chosen)
    spent = torch.zeros(len(chosen), device=noise.device)
    for i in range(0, len(noise), settings.micro_batch):
        rows = slice(i, i + settings.micro_batch)
        part = rollout.rows(rows)
        squares = _sample(model, condition.rows(rows), noise[rows], seeds[rows], settings, part)
        spent.add_(squares, alpha=len(part.latents) / len(noise))
        on_progress(min(rows.stop, len(noise)), len(noise))
    return replace(rollout, noise_share=spent.sqrt().to(rollout.latents.device))


def _unsampled(
    noise: Tensor, num_conditioning: int, settings: RolloutConfig, stochastic: list[int]
) -> VideoRollout:
    """A rollout whose tensors are yet to be written, in place: kept once, without copies of its parts."""
    N, C, frames, H, W = noise.shape
    S, states = len(stochastic), len({*stochastic, *(k + 1 for k in stochastic)})
    stored = getattr(torch, settings.storage_dtype)
    device = noise.device if settings.buffer_device == "model" else torch.device("cpu")
    room = partial(torch.empty, dtype=torch.float32, device=device)
    return VideoRollout(
        latents=room(N, C, frames, H, W),
        steps=tuple(stochastic),
        states=room(N, states, C, frames, H, W, dtype=stored),
        mask=room(N, S, 1, frames, H, W),
        zeta=room(N, S, C, frames - num_conditioning, H, W, dtype=stored),
        noise_share=room(S),
    )


def _sample(
    model: VelocityModel, condition: Condition, noise: Tensor, seeds: Tensor, settings: RolloutConfig,
    rollout: VideoRollout,
) -> Tensor:
    """Sample one micro-batch into its rows of `rollout`; return the squared noise_share of its steps, (S,)."""
    times, N = flow_times(settings.num_steps, settings.shift), len(noise)
    at = times.to(noise.device)
    storage = getattr(torch, settings.storage_dtype)
    context = StepContext(condition.frames.float(), first_time=float(times[1]))
    x = with_conditioning(noise.float(), context.conditioning)
    squares = torch.empty(len(rollout.steps), device=noise.device)
    for k in range(settings.num_steps):
        if k in rollout.state_steps:
            x = with_conditioning(x.to(storage).float(), context.conditioning)
            keep_state(rollout, k, x)
        t, s = at[k].expand(N), at[k + 1].expand(N)
        v = guided_velocity(model, x, t, condition, settings.cfg).float()
        if k not in rollout.steps:
            x = with_conditioning(ode_step(x, v, t, s, context).mean, context.conditioning)
            continue
        law = step(x, v, t, s, context, settings.sampler)
        z = step_noise(tuple(x.shape[1:]), seeds, k).to(x.device)
        x = with_conditioning((law.mean + law.std * z).to(storage).float(), context.conditioning)
        keep_transition(rollout, k, x, law)
        spent = (law.std[:, :, context.num_conditioning :] / float(times[k + 1])).square()
        squares[rollout.steps.index(k)] = spent.sum() / max(1, spent.numel())
    rollout.latents.copy_(x)
    return squares


def keep_state(rollout: VideoRollout, k: int, x: Tensor) -> None:
    """Write x before step k, in the storage dtype."""
    rollout.state(k).copy_(x)


def keep_transition(rollout: VideoRollout, k: int, x_s: Tensor, law: Step) -> None:
    """Write what training needs of step k beside its states: mask and normalised noise."""
    i = rollout.steps.index(k)
    rollout.mask[:, i] = law.mask
    rollout.zeta[:, i] = normalised_noise(x_s, law, x_s.shape[2] - rollout.zeta.shape[3])


def normalised_noise(x_s: Tensor, law: Step, num_conditioning: int) -> Tensor:
    """Return zeta of DD-14b, (x_s - mean) / std on generated frames, (N, C, F - K, H, W)."""
    K = num_conditioning
    return (x_s[:, :, K:] - law.mean[:, :, K:]).div_(law.std[:, :, K:])
