"""Train WM_txt on demonstrations: from a first frame and an instruction, the golden trajectory (RS-4). Shapes:
B episodes, T steps, S tokens, D values per token, J tasks, P probed values."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import get_task, task_names
from wm_nodes.core.seeding import initial_weights, numpy_stream
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.loop import LoopSettings, TrainingLoop
from wm_nodes.world_model.dynamics import ActionModel
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.text import TextModel, vocabulary_of
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.dynamics import HUBER_DELTA, LatentEpisodes, done_losses, token_weights
from wm_nodes.world_model.training.tokenizer import probe_loss

STEPS_AFTER_SUCCESS = 2


def train_text_model(
    tokenizer: Tokenizer, action_model: ActionModel, episodes: EpisodeArrays, data: LatentEpisodes,
    instructions: tuple[str, ...], config: RunConfig, seed: int, run_dir: Path | None, *, progress: bool = True,
) -> tuple[TextModel, dict[str, float]]:
    """Train on successful noiseless episodes, cut shortly after success; warm-started from the action model.

    Args:
        instructions: one per task of the episodes.

    Raises:
        ValueError: no successful demonstration.
    """
    rows = golden_rows(episodes)
    if not len(rows):
        raise ValueError(f"no successful episode of {' or '.join(demonstrators())} to learn goals from; collect more")
    settings = config.world_model
    with initial_weights(seed, "text_model_init"):
        model = TextModel(
            settings, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
            vocabulary=vocabulary_of(instructions), num_tasks=len(instructions),
        )
    shared = {name: t for name, t in action_model.state_dict().items() if not name.startswith("condition.")}
    model.load_state_dict(shared, strict=False)
    tokenizer.requires_grad_(False)
    by_task = [rows[rows[:, 1] == task] for task in range(len(instructions))]
    tasks = [task for task, found in enumerate(by_task) if len(found)]

    def loss(iteration: int) -> dict[str, Tensor]:
        stream = numpy_stream(seed, "text_batch", iteration)
        task = tasks[iteration % len(tasks)]
        chosen = by_task[task][stream.integers(0, len(by_task[task]), settings.batch_size)]
        index, length = torch.from_numpy(chosen[:, 0]), torch.from_numpy(chosen[:, 2])
        steps = int(length.max())
        target = data.latents[index][:, : steps + 1].float()
        mask = (torch.arange(steps) < length[:, None]).float()
        with compute_context(tokenizer.device):
            latents, positions, logits = _rollout(model, tokenizer, target[:, 0], instructions[task], steps)
        weight = token_weights(target, data.mean_change_S) * mask[..., None]
        errors = F.huber_loss(latents, target[:, 1:], delta=HUBER_DELTA, reduction="none").mean(-1)
        terms = {"latent": (errors * weight).sum() / weight.sum()}
        labels = data.success[index][:, 1 : steps + 1].float()
        terms["done"] = done_losses(logits, labels, mask[:, :, None].expand(-1, -1, settings.num_done_heads))
        known = torch.where(mask[..., None] > 0, data.truth[index][:, 1 : steps + 1], torch.nan).flatten(0, 1)
        terms["state"] = probe_loss(tokenizer, tokenizer.read_state_normalised(latents.flatten(0, 1)), known)
        terms["position"] = probe_loss(tokenizer, positions.flatten(0, 1), known)
        terms["loss"] = (
            terms["latent"] + settings.done_weight * terms["done"]
            + settings.state_weight * (terms["state"] + terms["position"])
        )
        return terms

    loop = TrainingLoop(
        "text_model", model, LoopSettings(settings.text_num_iterations, settings.learning_rate / 2), run_dir
    )
    metrics = loop.run(loss, progress=progress)
    return model, metrics


def demonstrators() -> tuple[str, ...]:
    """Behaviours without noise. Golden trajectories must have one best future: the mean of many is blurred."""
    return tuple(sorted({get_task(name).demonstrator for name in task_names()}))


def golden_rows(episodes: EpisodeArrays) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """(R, 3): episode, task, steps to learn from, for every noiseless episode that succeeds at a task."""
    rows = []
    for episode, behaviour in enumerate(episodes.behaviours):
        for task, name in enumerate(episodes.tasks):
            wins = np.flatnonzero(episodes.success[episode, :, task])
            if len(wins) and wins[0] > 0 and behaviour == get_task(name).demonstrator:
                rows.append((episode, task, min(int(wins[0]) + STEPS_AFTER_SUCCESS, int(episodes.lengths[episode]))))
    return np.array(rows, np.int64).reshape(-1, 3)


def _rollout(
    model: TextModel, tokenizer: Tokenizer, first: Tensor, instruction: str, steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Imagined latents (B, T, S, D), positions (B, T, P) and done logits (B, T, K, J) of frames 1..T."""
    caches = model.trunk.new_caches()
    current, frames, positions, logits = first.unsqueeze(1), list[Tensor](), list[Tensor](), list[Tensor]()
    for _ in range(steps):
        prediction = model(current, instruction, caches)
        current = tokenizer.normalise(current + prediction.change_BTSD)
        frames.append(current)
        positions.append(prediction.positions_BTQ)
        logits.append(prediction.done_logits_BTKJ)
    return torch.cat(frames, 1), torch.cat(positions, 1), torch.cat(logits, 1)
