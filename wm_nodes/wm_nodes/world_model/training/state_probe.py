"""Train the probe of a trained tokenizer on alone: what it reads off latents is what policies and losses see. Shapes:
F frames, S tokens, D values per token, P probed values."""

from pathlib import Path

import torch
from torch import Tensor

from wm_nodes.config.schema import TokenizerConfig
from wm_nodes.core.seeding import numpy_stream, torch_stream
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes
from wm_nodes.world_model.training.tokenizer import LATENT_NOISE, probe_loss

BATCH = 256
LEARNING_RATE = 2.0e-3


def train_state_probe(
    tokenizer: Tokenizer, data: LatentEpisodes, config: TokenizerConfig, seed: int, run_dir: Path | None
) -> dict[str, float]:
    """Train for tokenizer.probe_iterations on the recorded frames' latents; returns the last metrics.

    The loss is that of the tokenizer's training. Latents have its noise where they are continuous.
    """
    recorded = torch.cat((torch.ones_like(data.step_mask[:, :1]), data.step_mask), 1).flatten()
    frames = recorded.nonzero()[:, 0].cpu()
    latents_FSD, truth_FP = data.latents.flatten(0, 1), data.truth.flatten(0, 1)
    noise_std = LATENT_NOISE if tokenizer.kind == "continuous" else 0.0

    def loss(iteration: int) -> dict[str, Tensor]:
        chosen = frames[numpy_stream(seed, "state_probe_batch", iteration).integers(0, len(frames), BATCH)]
        index = chosen.to(latents_FSD.device)
        shown = latents_FSD[index].float()
        noise = torch.randn(shown.shape, generator=torch_stream(seed, "state_probe_noise", iteration))
        read = tokenizer.read_state_normalised(shown + noise_std * noise.to(shown.device))
        return {"loss": probe_loss(tokenizer, read, truth_FP[index])}

    assert tokenizer.probe is not None
    tokenizer.probe.requires_grad_(True)
    loop = TrainingLoop("state_probe", tokenizer.probe, config.probe_iterations, LEARNING_RATE, run_dir)
    metrics = loop.run(loss)
    tokenizer.probe.requires_grad_(False)
    return metrics
