"""Train the judge's position probe on recorded images. Shapes: B images, P positions."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.device import compute_device
from wm_nodes.core.seeding import initial_weights, numpy_stream, torch_stream
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.background import BackgroundBatches
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.training.tokenizer import episode_targets, known_huber, position_statistics

LEARNING_RATE = 1.0e-3
PIXEL_NOISE = 0.02


def train_position_probe(
    episodes: EpisodeArrays, config: RunConfig, seed: int, run_dir: Path | None
) -> tuple[PositionProbe, dict[str, float]]:
    """Train for as many iterations as the tokenizer; return the probe (averaged weights) and its last metrics (m).

    Half of each batch is blurred, as imagined frames are, so that a blur alone does not read as a wrong place.

    Raises:
        ValueError: no position is known (not NaN) in any recorded frame.
    """
    height, width = episodes.images.shape[2:4]
    images = episodes.images.reshape(-1, height, width, 3)
    truth = episode_targets(episodes).reshape(len(images), -1)
    frames = np.flatnonzero(episodes.frame_mask.reshape(-1) & np.isfinite(truth).any(-1))
    if not len(frames):
        raise ValueError("no recorded frame has ground truth; the judge's probe needs simulator episodes")
    with initial_weights(seed, "position_probe_init"):
        probe = PositionProbe(height, width, truth.shape[-1])
    mean, std = position_statistics(truth[frames])
    probe.mean.copy_(torch.from_numpy(mean))
    probe.std.copy_(torch.from_numpy(std))
    device = compute_device(config.device)
    probe.to(device)

    def read(iteration: int) -> tuple[Tensor, Tensor, Tensor]:
        rows = numpy_stream(seed, "position_probe_batch", iteration).choice(frames, config.tokenizer.batch_size)
        generator = torch_stream(seed, "position_probe_noise", iteration)
        noise = torch.randn((len(rows), 3, height, width), generator=generator)
        return torch.from_numpy(images[rows]), torch.from_numpy(truth[rows]), noise

    batches = BackgroundBatches(read, device)

    def loss(iteration: int) -> dict[str, Tensor]:
        shown, positions, noise = batches(iteration)
        pixels = shown.permute(0, 3, 1, 2).float() / 255
        half = len(shown) // 2
        pixels = torch.cat((pixels[:half], F.avg_pool2d(pixels[half:], 3, 1, 1, count_include_pad=False)))
        wanted = (positions - probe.mean) / probe.std
        found = probe(pixels + PIXEL_NOISE * noise)
        error_m = (found.detach() - wanted) * probe.std
        return {"loss": known_huber(found, wanted), "error_m": error_m.abs().nanmean()}

    loop = TrainingLoop("position_probe", probe, config.tokenizer.num_iterations, LEARNING_RATE, run_dir)
    return probe, loop.run(loss)
