"""Open-loop rollouts of held-out episodes by the action model, compared with the recordings.

Shapes: E episodes, T steps, S tokens, D values per token, J tasks, P probed values.

Positions are read off pictures, by the judge's own probe (world_model/position_probe.py), which was trained on real
frames only, and which no loss of the world model trains. Where a model folder has none, predicted frames
are encoded again and read by the tokenizer's probe. The reader's own error on real held-out frames is reported as the
floor, and copying the first frame is measured in the same way.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.core.statistics import bootstrap_ratio, wilson_of_groups
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.reward.picture_similarity import psnr_db, ssim
from wm_nodes.world_model.dynamics import ActionModel, done_signal
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.positions import columns_of, position_names
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.state_model import next_states
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.tokenizer import episode_targets

HORIZONS = (1, 2, 4, 8, 12, 16, 32, 64)
"""Steps after which rollouts are compared, beside the last one; see horizons_up_to."""
EARLY_STEPS, EARLY_SHARE = 3, 0.25
"""By how many steps, or which share of the episode if that is more, a done signal in time may precede the success."""
MOVED_M = 0.01
"""An object counts as moved when it ends this far from where it began."""
BATCH = 64


@dataclass(frozen=True)
class ImaginedEpisodes:
    """Rollouts of recorded actions from recorded first frames."""

    frames: UInt8Array
    """uint8 (E, T, H, W, 3), frames 1..T."""
    signals: FloatArray
    """float32 (E, T, J), pessimistic done probability of frames 1..T."""
    uncertainty: FloatArray
    """float32 (E, T, J)."""
    states: FloatArray
    """float32 (E, T, S), of frames 1..T; measured values as the model predicts them."""


def horizons_up_to(num_steps: int) -> list[int]:
    """HORIZONS of an episode of num_steps steps, and its last step, by which a model is judged."""
    return sorted({*(step for step in HORIZONS if step < num_steps), num_steps})


@torch.inference_mode()
def imagine_episodes(
    tokenizer: Tokenizer, model: ActionModel | TokenActionModel, episodes: EpisodeArrays
) -> ImaginedEpisodes:
    """Roll the recorded actions out from the recorded first frames, in batches."""
    images, actions, states = episodes.images[:, 0], episodes.actions, episodes.states
    rows = [slice(i, i + BATCH) for i in range(0, len(episodes), BATCH)]
    parts = [imagine(tokenizer, model, images[row], actions[row], states[row]) for row in rows]
    names = [field.name for field in fields(ImaginedEpisodes)]
    return ImaginedEpisodes(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@torch.inference_mode()
def imagine(
    tokenizer: Tokenizer, model: ActionModel | TokenActionModel, images: UInt8Array, actions: FloatArray,
    states: FloatArray,
) -> ImaginedEpisodes:
    """Roll actions out, all at once.

    Args:
        images: uint8 (E, H, W, 3), first frames. actions: (E, T, A).
        states: (E, T + 1, S); the measured values are read at the first frame alone.
    """
    current = tokenizer.encode(images)
    actions_ETA, states_ETS = (torch.from_numpy(array).to(current.device) for array in (actions, states))
    caches = model.trunk.new_ring_caches(len(images), current.device)
    frames, signals, spreads, reached = list[Tensor](), list[Tensor](), list[Tensor](), list[Tensor]()
    earlier = before = states_ETS[:, 0]
    for t in range(actions.shape[1]):
        acted, after = actions_ETA[:, t], states_ETS[:, t + 1]
        with compute_context(current.device):
            after = next_states(model, current, acted, before, earlier, after)
            current, logits = model.advance(current, acted, before, after, caches)
        earlier, before = before, after
        signal, spread = done_signal(logits)
        frames.append(tokenizer.decode(current))
        signals.append(signal)
        spreads.append(spread)
        reached.append(after)
    return ImaginedEpisodes(*(torch.stack(steps, 1).cpu().numpy() for steps in (frames, signals, spreads, reached)))


def position_reader(tokenizer: Tokenizer, probe: PositionProbe | None) -> Callable[[UInt8Array], FloatArray]:
    """What reads positions (E, T, P), m, off frames (E, T, H, W, 3), see above."""
    return probe.read if probe else partial(_read_frames, tokenizer)


def places_of_states(
    states: FloatArray, state_names: Sequence[str], task: str, first_truth: FloatArray
) -> FloatArray:
    """Positions (E, T, P) that states (E, T, S) say, NaN where they say none; of the tool those commanded. first_truth:
    (E, P), of the first states, by which the frame of the states is known."""
    places: FloatArray = np.full((*states.shape[:2], first_truth.shape[-1]), np.nan, np.float32)
    for column, name in enumerate(position_names(task)):
        for said in {name, name.replace("tool_", "tool_target_")} & {*state_names}:
            values = states[..., state_names.index(said)]
            places[..., column] = values + np.median(first_truth[:, column] - values[:, 0])
    return places


@torch.inference_mode()
def evaluate_rollouts(
    tokenizer: Tokenizer, imagined: ImaginedEpisodes, episodes: EpisodeArrays, *, threshold: float = 0.7,
    probe: PositionProbe | None = None, state_names: Sequence[str] = (),
) -> dict[str, float]:
    """Metrics by name of the episodes' rollouts (see docs/metrics.md); positions in cm, PSNR in dB, `_hNN` at step NN.

    object_/tool_: mean error of `rollout`, of the probe on real frames (`floor`), of the tokenizer's probe on their
    `latents`, of the first frame (`copy`), and rollout / copy (`ratio`, with its bootstrap interval `ratio_low` to
    `ratio_high`). object_moved_: over the episodes whose object moved. done_<task>_: episodes counted as successful
    when the signal exceeds `threshold` anywhere, against success anywhere in the recording.

    Without ground truth, where the tasks' files name no positions, or where the model reads none, there is no object_
    and tool_ and no moved_share.

    Args:
        state_names: positions are those that states say, of these values (places_of_states), in place of pictures.
    """
    truth = episode_targets(episodes)
    metrics: dict[str, float] = {"episodes": float(len(episodes))}
    thing, tool = (columns_of(episodes.tasks[0], name) for name in ("object", "tool"))
    has_reader = probe is not None or tokenizer.num_positions > 0
    has_positions = has_reader and truth.shape[-1] > 0 and bool(thing and tool)
    if has_positions:
        if state_names:
            reached = np.concatenate([episodes.states, imagined.states], 1)
            places = places_of_states(reached, state_names, episodes.tasks[0], truth[:, 0])
            real, predicted = places[:, : episodes.num_steps + 1], places[:, episodes.num_steps + 1 :]
        else:
            read = position_reader(tokenizer, probe)
            real, predicted = read(episodes.images), read(imagined.frames)
        moved = np.linalg.norm(truth[:, -1, thing] - truth[:, 0, thing], axis=-1) > MOVED_M
        metrics["moved_share"] = float(moved.mean())
    for horizon in horizons_up_to(episodes.num_steps):
        rows = episodes.lengths >= horizon
        if not rows.any():
            continue
        label = f"h{horizon:02d}"
        latents = tokenizer.encode(episodes.images[:, horizon])
        metrics |= _picture_metrics(tokenizer, imagined, episodes, latents, rows, horizon)
        if not has_positions:
            continue
        estimates = {
            "rollout": predicted[:, horizon - 1], "floor": real[:, horizon], "copy": real[:, 0],
            "latents": tokenizer.read_state(latents).cpu().numpy(),
        }
        for name, columns, chosen in (
            ("object", thing, rows), ("object_moved", thing, rows & moved), ("tool", tool, rows),
        ):
            pattern, tries = f"{name}_{{}}_{label}", episodes.independent[chosen]
            metrics |= _position_metrics(estimates, truth[:, horizon], columns, chosen, pattern, tries)
    frame_mask, labelled = episodes.step_mask, episodes.labelled
    for j, task in enumerate(episodes.tasks):
        rows = labelled[:, j]
        if not rows.any():
            continue
        signal, happened, in_time = _done(imagined, episodes, [j] * len(episodes), threshold)
        told = (signal[rows], happened[rows], in_time[rows])
        detection = detection_metrics(*told, threshold, episodes.independent[rows])
        metrics |= {f"done_{task}_{key}": value for key, value in detection.items()}
        metrics[f"done_{task}_uncertainty_p99"] = float(
            np.quantile(imagined.uncertainty[rows, :, j][frame_mask[rows]], 0.99)
        )
    return metrics


@torch.inference_mode()
def episode_errors(
    tokenizer: Tokenizer, model: ActionModel | TokenActionModel, episodes: EpisodeArrays, task: str, *,
    threshold: float, probe: PositionProbe | None = None,
) -> dict[str, FloatArray]:
    """Of the rollout of each episode, (E,): error of the object and of the tool after its last step (object_cm,
    tool_cm; not without ground truth), and whether the done signal exceeds `threshold` in time, or never in an
    episode that fails (done_right, bool), in `task` or, where that has parts, in the task it was recorded for.
    """
    imagined, rows = imagine_episodes(tokenizer, model, episodes), np.arange(len(episodes))
    own = [episodes.tasks.index(task if task in episodes.tasks else name) for name in episodes.recorded_tasks]
    signal, happened, in_time = _done(imagined, episodes, own, threshold)
    right = {"done_right": np.where(signal > threshold, in_time, ~happened)}
    if not episodes.ground_truth.shape[-1]:
        return right
    last = imagined.frames[rows, episodes.lengths - 1][:, None]
    estimate = position_reader(tokenizer, probe)(last)[:, 0]
    truth = episode_targets(episodes)[rows, episodes.lengths]
    errors = {
        f"{name}_cm": 100 * np.linalg.norm(estimate[:, columns] - truth[:, columns], axis=-1)
        for name in ("object", "tool") if (columns := columns_of(episodes.tasks[0], name))
    }
    return errors | right


def _done(
    imagined: ImaginedEpisodes, episodes: EpisodeArrays, tasks: Sequence[int], threshold: float
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """(E,), the highest done signal of each episode's task within the recorded steps, whether it succeeds, and whether
    it does before the signal exceeds the threshold or soon after it, see EARLY_STEPS."""
    rows, mask = np.arange(len(episodes)), episodes.step_mask
    signals: FloatArray = np.where(mask, imagined.signals[rows, :, tasks], 0)
    succeeded = episodes.success[rows, 1:, tasks] & mask
    latest = (signals > threshold).argmax(1) + np.maximum(EARLY_STEPS, EARLY_SHARE * episodes.lengths)
    soon = np.arange(mask.shape[1]) <= latest[:, None]
    return signals.max(1), succeeded.any(1), (succeeded & soon).any(1)


def detection_metrics(
    scores: FloatArray, positive: BoolArray, in_time: BoolArray, threshold: float, tries: NDArray[np.int64]
) -> dict[str, float]:
    """Precision and recall with their Wilson intervals over tries, and agreement, of scores > threshold, AUC, and both
    rates; NaN where undefined. in_time: whether a positive comes so soon after its score that it counts in `in_time`,
    the precision in time, and in agreement. tries: equal where two are not independent of each other."""
    fired = scores > threshold
    shares = {
        "precision": wilson_of_groups(positive[fired], tries[fired]),
        "in_time": wilson_of_groups(in_time[fired], tries[fired]),
        "recall": wilson_of_groups(fired[positive], tries[positive]),
    }
    return {
        **{f"{name}{end}": value for name, share in shares.items() for end, value in zip(("", "_low", "_high"), share)},
        "agreement": float(np.where(fired, in_time, ~positive).mean()),
        "auc": auc(scores, positive),
        "imagined_rate": float(fired.mean()),
        "real_rate": float(positive.mean()),
    }


def auc(scores: NDArray[np.floating[Any]], positive: BoolArray) -> float:
    """Probability that a positive outscores a negative, ties counting half; NaN without both kinds."""
    if positive.all() or not positive.any():
        return float("nan")
    above, below = scores[positive][:, None], scores[~positive][None]
    return float((above > below).mean() + 0.5 * (above == below).mean())


def _position_metrics(
    estimates: dict[str, FloatArray], truth_EP: FloatArray, columns: list[int], rows: BoolArray, pattern: str,
    tries: NDArray[np.int64],
) -> dict[str, float]:
    name, label = pattern.split("_{}_")
    errors = {
        key: 100 * np.linalg.norm(value[rows][:, columns] - truth_EP[rows][:, columns], axis=-1)
        for key, value in estimates.items()
    }
    metrics = {f"{name}_{key}_cm_{label}": _mean(value) for key, value in errors.items()}
    metrics[f"{name}_rollout_median_cm_{label}"] = float(np.median(errors["rollout"])) if rows.any() else float("nan")
    interval = bootstrap_ratio(errors["rollout"], errors["copy"], tries, seed=0)
    metrics |= {f"{name}_ratio_{end}_{label}": value for end, value in zip(("low", "high"), interval)}
    copied = metrics[f"{name}_copy_cm_{label}"]
    metrics[f"{name}_ratio_{label}"] = metrics[f"{name}_rollout_cm_{label}"] / copied if copied > 0 else float("nan")
    return metrics


def _picture_metrics(
    tokenizer: Tokenizer, imagined: ImaginedEpisodes, episodes: EpisodeArrays, latents_ESD: Tensor, rows: BoolArray,
    horizon: int,
) -> dict[str, float]:
    """latents_ESD: of the recorded frames at the horizon."""
    device, label = tokenizer.device, f"h{horizon:02d}"
    real, latents = torch.from_numpy(episodes.images[rows, horizon]).to(device), latents_ESD[torch.from_numpy(rows)]
    shown = {
        "rollout": torch.from_numpy(imagined.frames[rows, horizon - 1]).to(device),
        "recon": tokenizer.decode(latents), "copy": torch.from_numpy(episodes.images[rows, 0]).to(device),
    }
    metrics = dict[str, float]()
    for name, frames in shown.items():
        metrics[f"psnr_{name}_db_{label}"] = float(psnr_db(frames, real).mean())
        metrics[f"ssim_{name}_{label}"] = float(ssim(frames, real).mean())
        metrics[f"perceptual_{name}_{label}"] = float((tokenizer.encode(frames) - latents).abs().mean())
    return metrics


def _read_frames(tokenizer: Tokenizer, images_ETHW3: UInt8Array) -> FloatArray:
    flat = images_ETHW3.reshape(-1, *images_ETHW3.shape[2:])
    with torch.inference_mode():
        parts = [tokenizer.read_state(tokenizer.encode(flat[i : i + 256])) for i in range(0, len(flat), 256)]
    positions: FloatArray = torch.cat(parts).cpu().numpy().reshape(*images_ETHW3.shape[:2], -1)
    return positions


def _mean(values: NDArray[np.floating[Any]]) -> float:
    return float(values.mean()) if len(values) else float("nan")
