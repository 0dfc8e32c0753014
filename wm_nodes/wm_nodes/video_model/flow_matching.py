"""Flow matching: how the embedded video model learns (DD-3c). Shapes: B videos, C channels, F latent frames,
H W grid, K given.

x_t = (1 - t) x_0 + t eps on generated frames, clean on given ones; loss = mean over generated elements of
|v(x_t, t, c) - (eps - x_0)|^2. Half of the times are shifted by SHIFT, towards the noise, where motion is decided.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from wm_nodes.config.video import FlowMatchingConfig
from wm_nodes.core.device import device_of
from wm_nodes.core.seeding import torch_stream
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.video_model import Condition, VideoNetwork
from wm_nodes.video_model.kernels import with_conditioning

SHIFT = 3.0

Batches = Callable[[int], tuple[Tensor, Condition]]
"""iteration -> clean latents (B, C, F, H, W) and their condition."""


def train_video_model(
    model: VideoNetwork, batches: Batches, settings: FlowMatchingConfig, *, seed: int, run_dir: Path | None,
) -> dict[str, float]:
    """Train in place to the last iteration (resuming run_dir's checkpoint), ending with the averaged weights.

    The batches may be elsewhere than the model, which computes where it is.
    """
    device = device_of(model)
    loop = TrainingLoop("video_model", model, settings.num_iterations, settings.learning_rate, run_dir)

    def loss(iteration: int) -> dict[str, Tensor]:
        latents, condition = batches(iteration)
        latents, condition = latents.to(device), condition.to(device)
        return {"loss": flow_matching_loss(model, latents, condition, settings, seed, iteration)}

    return loop.run(loss)


def flow_matching_loss(
    model: VideoNetwork, latents: Tensor, condition: Condition, settings: FlowMatchingConfig, seed: int, iteration: int
) -> Tensor:
    """Return the flow-matching loss of one batch; times, noise and drops come from streams of the iteration."""
    B, K = len(latents), condition.num_conditioning
    generator = torch_stream(seed, "flow_matching", iteration)
    t = torch.rand(B, generator=generator, dtype=torch.float64)
    shifted = SHIFT * t / (1 + (SHIFT - 1) * t)
    t = torch.where(torch.arange(B) % 2 == 0, t, shifted).to(latents.device)
    noise = torch.randn(latents.shape, generator=generator).to(latents.device)
    hidden = torch.rand(B, generator=generator) < settings.drop
    if settings.hide_actions:
        hidden = torch.stack([hidden | (torch.rand(B, generator=generator) < settings.hide_actions), hidden], 1)
    share = t.to(latents.dtype).view(-1, 1, 1, 1, 1)
    x_t = with_conditioning((1 - share) * latents + share * noise, condition.frames)
    error = model(x_t, t, condition, hidden.to(latents.device)) - (noise - latents)
    loss: Tensor = error[:, :, K:].square().mean()
    return loss
