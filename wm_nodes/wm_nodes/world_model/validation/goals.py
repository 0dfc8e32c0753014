"""How near the goals that the text model imagines (RS-6) are to what was reached. Shapes: E episodes."""

import numpy as np
import torch

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.statistics import bootstrap_ratio, wilson_of_groups
from wm_nodes.core.types import FloatArray
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.positions import columns_of
from wm_nodes.world_model.text import imagine_goals, instruction_for, task_instruction
from wm_nodes.world_model.training.tokenizer import episode_targets
from wm_nodes.world_model.validation.open_loop import position_reader


@torch.inference_mode()
def goal_metrics(models: WorldModels, episodes: EpisodeArrays, config: RunConfig, task: str) -> dict[str, float]:
    """Metrics by name (see docs/metrics.md) over the episodes that succeed at `task` after their first frame; none
    without such episodes or without a text model.

    goal_episodes: with an instruction of words that the text model knows; goal_left_out: the others.
    goal_found: share of imagined episodes whose done signal exceeds reward.goal_threshold. goal_object_cm,
    goal_tool_cm, goal_perceptual: distance of the goal, imagined from the first frame and the instruction, from the
    frame of the first success; `_copy`: of the first frame from it; `_ratio_low`, `_ratio_high`: bootstrap interval of
    the first over the second. Positions are read by the probe; without positions there is no object and tool.
    """
    column = models.task_index(task)
    won = episodes.success[..., column] & episodes.labelled[:, column, None] & episodes.frame_mask
    rows = np.flatnonzero(won.any(1) & ~won[:, 0])
    if models.text is None or not len(rows):
        return {}
    otherwise = task_instruction(task, models.spec)
    told = [
        instruction_for(task, episodes.recorded_tasks[row], episodes.instructions[row], otherwise) for row in rows
    ]
    known = np.array([models.text.knows(text) for text in told])
    rows, instructions = rows[known], [text for text, knows in zip(told, known) if knows]
    metrics = {"goal_episodes": float(known.sum()), "goal_left_out": float((~known).sum())}
    if not len(rows):
        return metrics
    reached = won[rows].argmax(1)
    imagined = imagine_goals(
        models.text, models.tokenizer, episodes.images[rows, 0], instructions, [column] * len(rows),
        horizon=episodes.num_steps, threshold=config.reward.goal_threshold,
    )
    for end, value in zip(("", "_low", "_high"), wilson_of_groups(imagined.found, episodes.independent[rows])):
        metrics[f"goal_found{end}"] = value
    errors = dict[tuple[str, str], FloatArray]()
    read, truth = position_reader(models.tokenizer, models.probe), episode_targets(episodes)[rows, reached]
    has_positions = truth.shape[-1] > 0 and models.tokenizer.num_positions > 0
    places = {name: columns for name in ("object", "tool") if has_positions and (columns := columns_of(task, name))}
    real = models.tokenizer.encode(episodes.images[rows, reached])
    for ending, frames in (("", imagined.goals), ("_copy", episodes.images[rows, 0])):
        found = read(frames[:, None])[:, 0] if places else truth
        for name, columns in places.items():
            errors[name, ending] = 100 * np.linalg.norm(found[:, columns] - truth[:, columns], axis=-1)
            metrics[f"goal_{name}{ending}_cm"] = float(errors[name, ending].mean())
        distance = (models.tokenizer.encode(frames) - real).abs().flatten(1).mean(1).cpu().numpy()
        errors["perceptual", ending] = distance
        metrics[f"goal_perceptual{ending}"] = float(distance.mean())
    for name in (*places, "perceptual"):
        low, high = bootstrap_ratio(errors[name, ""], errors[name, "_copy"], episodes.independent[rows], seed=0)
        metrics |= {f"goal_{name}_ratio_low": low, f"goal_{name}_ratio_high": high}
    return metrics
