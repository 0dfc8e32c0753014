"""What must hold on any video model before GRPO trains it. Each check states what it found, and what to do if it fails.

Shapes: N videos (a few), C channels, F latent frames, H W latent grid.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor, nn

from wm_nodes.learning.grpo_settings import GrpoSettings
from wm_nodes.learning.video_grpo import GrpoLearner
from wm_nodes.video_model import (
    Condition,
    RolloutBuffer,
    RolloutSettings,
    SamplerSettings,
    VideoRollout,
    config_hash,
    guided_velocity,
    initial_noise,
    sample_videos,
)
from wm_nodes.video_model.kernels import with_conditioning

RATIO_LIMIT, ODE_LIMIT, KL_LIMIT = 1e-5, 1e-4, 1e-10
FLAT_LIMIT = 1.5
"""The 95 % quantile of a useful mask lies at least this many times above its 20 % quantile."""
MIB = 2**20


@dataclass(frozen=True)
class Finding:
    """One check. value: what was measured, as text. remedy: what to do where it failed."""

    name: str
    passed: bool
    value: str
    remedy: str


def examine(
    model: nn.Module, condition: Condition, shape: tuple[int, int, int, int], rollout: RolloutSettings,
    grpo: GrpoSettings, *, seed: int = 0,
) -> list[Finding]:  # fmt: skip
    """Sample a few videos of shape (C, F, H, W) and check them; the model's weights are as before afterwards.

    Args:
        condition: of N >= 2 videos; two of them at least should move.
    """
    seeds = torch.arange(len(condition.actions)) + seed
    noise = initial_noise(shape, seeds).to(next(model.parameters()).device)
    model.eval()
    sampled = sample_videos(model, condition, noise, seeds, rollout)
    buffer = _buffer(sampled, condition, rollout)
    return [
        *_first_update(model, buffer, rollout, grpo, seed),
        _ode(model, condition, noise, seeds, rollout),
        _mask(sampled, condition.num_conditioning, rollout),
        _round_trip(buffer),
        _memory(model, sampled, grpo),
    ]


def _ode(
    model: nn.Module, condition: Condition, noise: Tensor, seeds: Tensor, rollout: RolloutSettings
) -> Finding:
    """The sampler without noise against the plain Euler sum over its own velocities."""
    settings = replace(rollout, sampler=SamplerSettings("cps", 0.0))
    found = sample_videos(model, condition, noise, seeds, settings, []).latents
    times, x = rollout.times, with_conditioning(noise.float(), condition.frames.float())
    with torch.no_grad():
        for t, s in pairwise(times.tolist()):
            v = guided_velocity(model, x, torch.full((len(x),), t, dtype=torch.float64), condition, rollout.cfg).float()
            x = with_conditioning(x + (s - t) * v, condition.frames.float())
    error = float((found - x).abs().max() / x.abs().max())
    return Finding(
        "eta = 0 is the Euler ODE step", error < ODE_LIMIT, f"largest relative difference {error:.1e}",
        "check the adapter's sign and time convention: t = 1 is noise, v = eps - x0",
    )  # fmt: skip


def _mask(sampled: VideoRollout, num_conditioning: int, rollout: RolloutSettings) -> Finding:
    name = "the mask is not flat"
    if rollout.sampler.arm != "dyndiff":
        return Finding(name, True, f"arm {rollout.sampler.arm} has none", "")
    cells = sampled.mask[:, :, :, num_conditioning:].flatten().float()
    low, high = (float(cells.kthvalue(max(1, int(q * len(cells)))).values) for q in (0.2, 0.95))
    return Finding(
        name, high > FLAT_LIMIT * low, f"20 % quantile {low:.2f}, 95 % quantile {high:.2f}",
        "no motion was seen: take contexts that move, check that given frames are clean, raise mask.quantile",
    )  # fmt: skip


def _round_trip(buffer: RolloutBuffer) -> Finding:
    again = RolloutBuffer.from_bytes(buffer.to_bytes())
    equal = bool(torch.equal(again.rollout.states, buffer.rollout.states)) and again.config_hash == buffer.config_hash
    size = f"{buffer.num_bytes / MIB:.1f} MiB"
    return Finding("a saved buffer comes back equal", equal, size, "report this as a bug")


def _memory(model: nn.Module, sampled: VideoRollout, grpo: GrpoSettings) -> Finding:
    """What each KL anchor keeps beside the trained weights, for this buffer."""
    weights = sum(p.nbytes for p in model.parameters())
    zeta = 0 if sampled.zeta is None else sampled.zeta.nbytes
    text = (
        f"frozen, moving, dual: {weights / MIB:.1f} MiB of weights; buffer: {zeta / MIB:.1f} MiB of noise and "
        f"{sampled.mask.nbytes / MIB:.1f} MiB of masks for {len(sampled.latents)} videos (noise_store seed: "
        f"{sampled.seeds.nbytes} bytes); lora_off: nothing; chosen: {grpo.kl.anchor}"
    )
    return Finding("memory of the KL anchors", True, text, "")


def _first_update(
    model: nn.Module, buffer: RolloutBuffer, rollout: RolloutSettings, grpo: GrpoSettings, seed: int
) -> tuple[Finding, Finding]:
    """Ratio and KL of one update that moves nothing; the anchor is the buffer's."""
    settings = replace(
        grpo, trains="all", updates_per_buffer=1, learning_rate=0.0, weight_decay=0.0, ema_decay=0.0,
        kl=replace(grpo.kl, mode="mean", anchor="buffer", beta=1.0), ratio_norm=False,
        advantage=replace(grpo.advantage, best_of_n=0),
    )  # fmt: skip
    learner = GrpoLearner(model, settings, rollout, seed=seed)
    (update,) = learner.train(buffer.with_rewards({"total": torch.arange(len(buffer), dtype=torch.float64)})).updates
    model.zero_grad(set_to_none=True)
    model.eval()
    off = abs(update.ratio_mean - 1)
    return Finding(
        "ratio is 1 on the first update", off < RATIO_LIMIT, f"mean ratio differs from 1 by {off:.1e}",
        "make rollout and training pass alike: dtype, micro_batch, cfg, dropout off, attention kernels",
    ), Finding(
        "KL is 0 at the anchor", update.kl < KL_LIMIT, f"{update.kl:.1e}",
        "as for the ratio; noise kept in bfloat16 alone gives 1e-6 (rollout.storage_dtype, noise_store)",
    )  # fmt: skip


def _buffer(sampled: VideoRollout, condition: Condition, rollout: RolloutSettings) -> RolloutBuffer:
    count = len(sampled.latents)
    return RolloutBuffer(
        sampled, condition, torch.zeros(count, dtype=torch.int64), torch.arange(count), {},
        torch.ones(count, dtype=torch.bool), 0, 0, config_hash(rollout),
    )  # fmt: skip
