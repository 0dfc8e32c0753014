"""Whether imagined frames obey actions, also such as no recording holds. Shapes: E episodes, T steps, A action,
S state.

A model that only goes on as recordings usually do predicts recorded actions well and ignores others.
"""

from dataclasses import replace

import numpy as np
import torch

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.tool_control import CommandedMove
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.reward.picture_similarity import psnr_db
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.positions import columns_of
from wm_nodes.world_model.training.tokenizer import episode_targets
from wm_nodes.world_model.validation.open_loop import horizons_up_to, imagine_episodes, position_reader


def controllability_metrics(
    models: WorldModels, episodes: EpisodeArrays, spec: EnvironmentSpec
) -> dict[str, float]:
    """Metrics by name (see docs/metrics.md), `_hNN` at step NN. Episodes count that are at least that long, and whose
    other actions are.

    psnr_shuffled_drop_db: PSNR of rollouts of the recorded actions less that of rollouts of the next episode's actions,
    both against the recording. tool_command_cm: how far the imagined tool is from where the recorded actions command
    it; tool_shuffled_cm: the same of the next episode's.

    Args:
        spec: of the simulator, whose rule turns actions into commands.
    """
    actions = {"command": episodes.actions, "shuffled": np.roll(episodes.actions, 1, axis=0)}
    read = position_reader(models.tokenizer, models.probe)
    tool = columns_of(episodes.tasks[0], "tool")
    first = episode_targets(episodes)[:, 0][:, tool]
    frames, errors = dict[str, UInt8Array](), dict[str, FloatArray]()
    for name, taken in actions.items():
        commanded = under_actions(episodes, taken, spec)
        frames[name] = imagine_episodes(models.tokenizer, models.action, commanded).frames
        wanted = first[:, None] + commanded.states[:, 1:, :3] - commanded.states[:, :1, :3]
        if tool:
            errors[name] = 100 * np.linalg.norm(read(frames[name])[..., tool] - wanted, axis=-1)
    metrics = dict[str, float]()
    for horizon in horizons_up_to(episodes.num_steps):
        rows = np.minimum(episodes.lengths, np.roll(episodes.lengths, 1)) >= horizon
        if not rows.any():
            continue
        likeness = {
            name: psnr_db(*map(torch.from_numpy, (shown[rows, horizon - 1], episodes.images[rows, horizon])))
            for name, shown in frames.items()
        }
        drop = float((likeness["command"] - likeness["shuffled"]).mean())
        metrics[f"psnr_shuffled_drop_db_h{horizon:02d}"] = drop
        for name, error in errors.items():
            metrics[f"tool_{name}_cm_h{horizon:02d}"] = float(error[rows, horizon - 1].mean())
    return metrics


def under_actions(episodes: EpisodeArrays, actions_ETA: FloatArray, spec: EnvironmentSpec) -> EpisodeArrays:
    """The episodes with other actions, and the states that these command."""
    return replace(episodes, actions=actions_ETA, states=follow(episodes.states[:, 0], actions_ETA, spec))


def follow(first_ES: FloatArray, actions_ETA: FloatArray, spec: EnvironmentSpec) -> FloatArray:
    """Commanded states (E, T + 1, S) of actions, from the first ones on; measured values stay as they are."""
    move, actions = CommandedMove(spec, torch.device("cpu")), torch.from_numpy(actions_ETA)
    states = [torch.from_numpy(first_ES)]
    for t in range(actions.shape[1]):
        states.append(move(states[-1], actions[:, t]))
    return torch.stack(states, 1).numpy()
