"""Train a model of states on recorded ones (RS-1g). Shapes: B parts of episodes, T steps, P state, K done heads."""

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.core.seeding import numpy_stream, torch_stream
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.state_model import StateModel
from wm_nodes.world_model.training.done import bootstrap_masks, done_losses, done_mask
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes, first_frames, tool_moves

BATCH, STEPS = 256, 8
LEARNING_RATE = 2.0e-3
DELTA = 0.1
"""Of the Huber loss, in multiples of change_scale: most steps move nothing, and a squared error would let all drift."""
READING_NOISE_M = 0.004
"""Standard deviation of what the lengths of a part are off by, all along, as a reader's are."""


def train_state_model(
    model: StateModel, data: LatentEpisodes, num_iterations: int, seed: int, run_dir: Path | None
) -> dict[str, float]:
    """Train the model; returns its last metrics.

    From a random recorded step it goes on from its own predictions for STEPS steps. Done heads learn from the recorded
    states of these steps.
    """
    device, steps = data.states.device, min(STEPS, data.actions.shape[1])
    heads = bootstrap_masks(len(data), model.num_heads, seed).to(device)
    lengths, moves = data.step_mask.sum(1).cpu(), tool_moves(data).cpu()
    columns, scale = model.columns, model.change_scale[model.columns]

    def loss(iteration: int) -> dict[str, Tensor]:
        rows = torch.from_numpy(numpy_stream(seed, "state_model_batch", iteration).integers(0, len(data), BATCH))
        stream = torch_stream(seed, "state_model_part", iteration)
        first = first_frames(lengths[rows], moves[rows], steps, stream)
        noise = torch.zeros(BATCH, 1, data.states.shape[-1])
        noise[:, 0, model.lengths] = READING_NOISE_M * torch.randn(BATCH, len(model.lengths), generator=stream)
        index = rows.to(device).unsqueeze(1)
        frames = first.to(device).unsqueeze(1) + torch.arange(-1, steps + 1, device=device)
        states = data.states[index, frames.clamp(min=0)] + noise.to(device)
        recorded = data.step_mask[index, frames[:, 1:-1]].float()
        earlier, now, errors = states[:, 0], states[:, 1], list[Tensor]()
        for t in range(steps):
            earlier, now = now, model.next_states(now, earlier, states[:, t + 2])
            off = (now - states[:, t + 2])[:, columns] / scale
            errors.append(F.huber_loss(off, torch.zeros_like(off), delta=DELTA, reduction="none").mean(-1) / DELTA)
        change = (torch.stack(errors, 1) * recorded).sum() / recorded.sum().clamp_min(1)
        mask = done_mask(data, index[:, 0], recorded, heads[index[:, 0]])
        labels = data.success[index, frames[:, 2:]].float()
        done = done_losses(model.done_logits(states[:, 2:], states[:, 1:-1]), labels, mask)
        return {"loss": change + done, "change": change, "done": done}

    return TrainingLoop("state_model", model, num_iterations, LEARNING_RATE, run_dir).run(loss)
