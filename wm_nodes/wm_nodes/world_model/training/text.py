"""Train WM_txt on demonstrations: from a first frame and an instruction, the golden trajectory (RS-4). Shapes:
B episodes, T steps, S tokens, D values per token, J tasks, P probed values."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import get_task, task_names
from wm_nodes.core.seeding import initial_weights, numpy_stream
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.dynamics import ActionModel, Prediction
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.text import TextModel, instruction_for, vocabulary_of
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.dynamics import (
    RolloutTerms,
    roll_out,
    roll_out_for_device,
    rollout_losses,
    wants_few_kernels,
)
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes

STEPS_AFTER_SUCCESS = 2


def train_text_model(
    tokenizer: Tokenizer, action_model: ActionModel, episodes: EpisodeArrays, data: LatentEpisodes,
    instructions: Sequence[str], config: RunConfig, seed: int, run_dir: Path | None,
) -> tuple[TextModel, dict[str, float]]:
    """Train on successful noiseless episodes, cut shortly after success, each with its own instruction for its task;
    warm-started from the action model.

    Args:
        instructions: one per task, for episodes that were recorded for another one.

    Raises:
        ValueError: no successful demonstration, or an instruction without or with too many words.
    """
    rows = golden_rows(episodes)
    if not len(rows):
        raise ValueError(f"no successful episode of {' or '.join(demonstrators())} to learn goals from; collect more")
    settings = config.world_model
    with initial_weights(seed, "text_model_init"):
        model = TextModel(
            settings, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
            vocabulary=vocabulary_of((*instructions, *episodes.instructions)), num_tasks=len(instructions),
            num_positions=tokenizer.num_positions,
        )
    model.condition(row_instructions(episodes, rows, instructions))  # raises before a long training, not in it
    shared = {name: t for name, t in action_model.state_dict().items() if not name.startswith("condition.")}
    model.load_state_dict(shared, strict=False)
    model.to(tokenizer.device)
    tokenizer.requires_grad_(False)
    by_task = [rows[rows[:, 1] == task] for task in range(len(instructions))]
    tasks = [task for task, its_rows in enumerate(by_task) if len(its_rows)]

    def loss(iteration: int) -> dict[str, Tensor]:
        stream = numpy_stream(seed, "text_batch", iteration)
        task = tasks[iteration % len(tasks)]
        chosen = by_task[task][stream.integers(0, len(by_task[task]), settings.batch_size)]
        steps = int(chosen[:, 2].max())
        index, _, length = torch.from_numpy(chosen).to(tokenizer.device).unbind(1)
        mask = (torch.arange(steps, device=length.device) < length[:, None]).float()
        texts = row_instructions(episodes, chosen, instructions)
        with compute_context(tokenizer.device):
            terms = _roll_out(model, tokenizer, data.latents[index][:, :1].float(), texts, steps)
        all_heads = torch.ones(len(index), settings.num_done_heads, device=length.device)
        return rollout_losses(terms, tokenizer, data, index, mask, all_heads, settings)

    loop = TrainingLoop("text_model", model, settings.text_num_iterations, settings.learning_rate / 2, run_dir)
    return model, loop.run(loss)


def _roll_out(
    model: TextModel, tokenizer: Tokenizer, first: Tensor, instructions: Sequence[str], steps: int
) -> RolloutTerms:
    if wants_few_kernels(first.device):
        condition, visible = model.condition_of(instructions, len(first), steps)
        real = first.expand(-1, steps, -1, -1)
        anchors = torch.arange(steps, device=first.device).expand(len(first), -1) == 0
        return roll_out_for_device(model, tokenizer, real, anchors, condition, visible)
    caches = model.trunk.new_caches()

    def predict(t: int, latents: Tensor) -> Prediction:
        return model(latents, instructions, caches)  # type: ignore[no-any-return]

    return roll_out(predict, tokenizer, first, steps)


def demonstrators() -> tuple[str, ...]:
    """Behaviours without noise. Golden trajectories must have one best future: the mean of many is blurred."""
    return tuple(sorted({get_task(name).model.demonstrator for name in task_names()}))


def golden_rows(episodes: EpisodeArrays) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """(R, 3): episode, task, steps to learn from, for every noiseless episode that succeeds at a task; for a task
    without a file whoever succeeds has demonstrated."""
    rows, labelled = [], episodes.labelled
    for episode, behaviour in enumerate(episodes.behaviours):
        for task, name in enumerate(episodes.tasks):
            wins = np.flatnonzero(episodes.success[episode, :, task] & labelled[episode, task])
            is_demonstrated = name not in task_names() or behaviour == get_task(name).model.demonstrator
            if len(wins) and wins[0] > 0 and is_demonstrated:
                rows.append((episode, task, min(int(wins[0]) + STEPS_AFTER_SUCCESS, int(episodes.lengths[episode]))))
    return np.array(rows, np.int64).reshape(-1, 3)


def row_instructions(
    episodes: EpisodeArrays, rows: np.ndarray[tuple[int, int], np.dtype[np.int64]], instructions: Sequence[str]
) -> list[str]:
    """The instruction of each of the golden `rows` for its task; `instructions`: one per task, see instruction_for."""
    return [
        instruction_for(
            episodes.tasks[task], episodes.recorded_tasks[episode], episodes.instructions[episode], instructions[task]
        )
        for episode, task, _ in rows
    ]
