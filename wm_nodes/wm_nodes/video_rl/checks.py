"""Checks of a video model before GRPO trains it; each states what it measured, and what to do if it fails.

Shapes: N videos (a few), C channels, F latent frames, H W latent grid.
"""

from dataclasses import dataclass

import torch
from torch import nn

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import RolloutConfig, VideoRlConfig
from wm_nodes.core.device import device_of
from wm_nodes.video_model import Condition, RolloutBuffer, VideoRollout, initial_noise
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.sampling import sample_buffer

RATIO_LIMIT, KL_LIMIT = 1e-5, 1e-10
ROUNDED_RATIO_LIMIT, ROUNDED_KL_LIMIT = 1e-4, 3e-6
"""Where the noise is kept in bfloat16; the mean ratio's error falls with the root of the elements."""
FLAT_LIMIT = 1.5
"""The 95 % quantile of a useful mask lies at least this many times above its 20 % quantile."""


@dataclass(frozen=True)
class CheckResult:
    """One check."""

    name: str
    """In words."""
    passed: bool
    """Whether what was measured is within the limit."""
    value: str
    """What was measured, as text."""
    remedy: str
    """What to do where it failed."""


def examine(
    model: nn.Module, condition: Condition, shape: tuple[int, int, int, int], config: VideoRlConfig
) -> list[CheckResult]:
    """Sample a few videos of shape (C, F, H, W) and check them; the model's weights are as before afterwards. With
    objective nft, which has no ratio and no KL, no first update is made.

    Args:
        condition: of N >= 2 videos, where the model is; two of them at least should move.
        config: its seed, window, rollout and grpo are used.

    Raises:
        ValueError: nothing can be trained with these settings: a sampler without noise, no step that can train, an
            anchor lora_off without an adapter.
    """
    rollout, videos = config.rollout, torch.arange(len(condition.actions))
    seeds, group = videos + config.seed, torch.zeros_like(videos)
    noise = initial_noise(shape, seeds).to(device_of(model))
    model.eval()
    buffer = sample_buffer(model, config, condition, noise, seeds, group, videos, 0, 0)
    broken = (~buffer.rollout.latents.isfinite()).flatten(1).any(1)
    if bool(broken.any()):
        return [CheckResult(
            "sampled videos are finite", False, f"{int(broken.sum())} of {len(broken)} are not",
            "float16 overflows where bfloat16 does not; check the weights, and the latents' scale",
        )]
    first = () if config.grpo.objective == "nft" else _check_first_update(model, buffer, config)
    return [*first, _check_mask(buffer.rollout, condition.num_conditioning, rollout)]


def _check_mask(sampled: VideoRollout, num_conditioning: int, rollout: RolloutConfig) -> CheckResult:
    name = "the mask is not flat"
    if rollout.sampler.arm != "dyndiff":
        return CheckResult(name, True, f"arm {rollout.sampler.arm} has none", "")
    if sampled.latents.shape[2] == 1:
        return CheckResult(name, True, "1 everywhere: a single frame has no motion", "")
    cells = sampled.mask[:, :, :, num_conditioning:].flatten().float()
    low, high = (float(cells.kthvalue(max(1, int(q * len(cells)))).values) for q in (0.2, 0.95))
    return CheckResult(
        name, high > FLAT_LIMIT * low, f"20 % quantile {low:.2f}, 95 % quantile {high:.2f}",
        "no motion was seen: take contexts that move, check that given frames are clean, raise mask.quantile",
    )


def _check_first_update(
    model: nn.Module, buffer: RolloutBuffer, config: VideoRlConfig
) -> tuple[CheckResult, CheckResult]:
    """Make an update that changes no weight; a transition beyond the ratio's limit counts as clipped."""
    ratio_limit, kl_limit = RATIO_LIMIT, KL_LIMIT
    if config.rollout.storage_dtype == "bfloat16":
        ratio_limit, kl_limit = ROUNDED_RATIO_LIMIT, ROUNDED_KL_LIMIT
    settings = config.grpo.with_values(
        updates_per_buffer=1, learning_rate=0.0, weight_decay=0.0, clip=ratio_limit,
        kl=config.grpo.kl.with_values(mode="mean", beta=1.0), advantage=load_video_config("base").grpo.advantage,
    )
    rewarded = buffer.with_rewards({"total": torch.arange(len(buffer), dtype=torch.float64)})
    trainable = [p.requires_grad for p in model.parameters()]
    try:
        (update,) = GrpoLearner(model, settings, config.rollout, seed=config.seed).train(rewarded).updates
    finally:
        for parameter, trains in zip(model.parameters(), trainable, strict=True):
            parameter.requires_grad_(trains)
            parameter.grad = None
        model.eval()
    error, outside = abs(update.ratio_mean - 1), update.clip_low_share + update.clip_high_share
    return CheckResult(
        "ratio is 1 on the first update", error < ratio_limit and outside == 0,
        f"mean ratio differs from 1 by {error:.1e}, {outside:.0%} of the transitions by more than {ratio_limit:g}",
        "make rollout and training pass alike: dtype, micro_batch, dropout off, attention kernels; storage_dtype "
        "float32",
    ), CheckResult(
        "KL is 0 at the anchor", update.kl < kl_limit, f"{update.kl:.1e} to {config.grpo.kl.anchor}",
        "as for the ratio",
    )
