"""Train the reader of where things are (environments/object_reader.py). Shapes: B images, H W 3 image, P state."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.device import compute_device
from wm_nodes.core.seeding import initial_weights, numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.environments.object_reader import SCALE_M, ObjectReader
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.background import BackgroundBatches
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.precision import compute_context

LEARNING_RATE = 3.0e-3
HUBER = 0.1
"""In multiples of SCALE_M."""


def train_object_reader(
    episodes: EpisodeArrays, spec: EnvironmentSpec, config: RunConfig, run_dir: Path | None
) -> tuple[ObjectReader, dict[str, float]]:
    """Train for world_model.object_reader_iterations on recordings whose states say the truth; returns the reader
    (averaged weights) and its last metrics, error_m among them."""
    height, width = episodes.images.shape[2:4]
    images = episodes.images.reshape(-1, height, width, 3)
    states = episodes.states.reshape(len(images), -1)
    frames = np.flatnonzero(episodes.frame_mask.reshape(-1))
    with initial_weights(config.seed, "object_reader_init"):
        reader = ObjectReader(spec)
    commanded, wanted = states[frames][:, reader.commanded], states[frames][:, reader.measured]
    reader.commanded_mean.copy_(torch.from_numpy(commanded.mean(0)))
    reader.commanded_scale.copy_(torch.from_numpy(commanded.std(0)).clamp_min(1e-3))
    reader.mean.copy_(torch.from_numpy(wanted.mean(0)))
    device = compute_device(config.device)
    reader.to(device)

    def read(iteration: int) -> tuple[Tensor, Tensor]:
        rows = numpy_stream(config.seed, "object_reader_batch", iteration).choice(frames, config.tokenizer.batch_size)
        return torch.from_numpy(images[rows]), torch.from_numpy(states[rows])

    batches = BackgroundBatches(read, device)

    def loss(iteration: int) -> dict[str, Tensor]:
        shown, state = batches(iteration)
        with compute_context(device):
            found = reader(shown.permute(0, 3, 1, 2).float() / 255, state[:, reader.commanded])
        errors = found - state[:, reader.measured]
        return {"loss": F.huber_loss(errors / SCALE_M, torch.zeros_like(errors), delta=HUBER) / HUBER,
                "error_m": errors.detach().abs().mean()}

    iterations = config.world_model.object_reader_iterations
    loop = TrainingLoop("object_reader", reader, iterations, LEARNING_RATE, run_dir)
    return reader, loop.run(loss)
