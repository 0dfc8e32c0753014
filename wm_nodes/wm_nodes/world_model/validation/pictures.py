"""How far rollouts are from the recording by their pictures alone: what is known without ground truth. Shapes:
E episodes, T steps, S tokens, D values per token, N pixels.

The distance of two frames is the mean absolute difference of the latents that the tokenizer encodes them to. What the
latents themselves have lost is seen in the pixels that vary between episodes at the same step.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from rich.table import Table
from torch import Tensor

from wm_nodes.core.statistics import bootstrap_ratio
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.reports.console_table import decimal, make_table
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.validation.acceptance_report import at_step
from wm_nodes.world_model.validation.controllability import under_actions
from wm_nodes.world_model.validation.open_loop import BATCH, ImaginedEpisodes, horizons_up_to, imagine_episodes

VARIES = 0.04
"""A pixel varies between episodes whose standard deviation, of [0, 1], is above this: less may be noise."""
WORST = 0.9
"""Quantile of the varying pixels: the tenth that is shown worst."""
ENOUGH = 24
"""Episodes whose variance per pixel says something: of 8, good models fail."""
SAME_ACTION = 1e-3
"""Two episodes whose actions differ by less than this on average show nothing of what actions do."""


@torch.inference_mode()
def picture_metrics(models: WorldModels, imagined: ImaginedEpisodes, episodes: EpisodeArrays) -> dict[str, float]:
    """Metrics by name of the episodes' rollouts, `_hNN` at step NN, of the `feature_episodes` that are so long.

    feature_ratio: distance of the rollout to the recording over that of the first frame: 1 is as good as copying it.
    feature_floor: the same of recorded frames that are encoded and decoded, which a rollout can hardly undercut.
    other_actions: distance under the next episode's actions over that under the recorded ones, of episodes whose
    actions differ: 1 where actions are ignored. `_low`, `_high`: 95 %, bootstrap over tries.
    varying_error: see there, of encoded and decoded frames, at these steps and of the first ones (h00).
    """
    tokenizer, others = models.tokenizer, np.roll(episodes.actions, 1, axis=0)
    misled = imagine_episodes(tokenizer, models.action, under_actions(episodes, others, models.spec)).frames
    differ = np.abs(episodes.actions - others).mean(2)
    first = episodes.images[:, 0]
    decoded = _in_batches(tokenizer.decode, _in_batches(tokenizer.encode, first)).cpu().numpy()
    metrics = {"varying_error_h00": varying_error(decoded, first)}
    for horizon in horizons_up_to(episodes.num_steps):
        rows = np.flatnonzero(episodes.lengths >= horizon)
        if not len(rows):
            continue
        real = _in_batches(tokenizer.encode, episodes.images[rows, horizon])
        reconstructed = _in_batches(tokenizer.decode, real).cpu().numpy()
        rolled, copied, floor = (
            _distances(tokenizer, frames, real)
            for frames in (imagined.frames[rows, horizon - 1], episodes.images[rows, 0], reconstructed)
        )
        both = (np.roll(episodes.lengths, 1)[rows] >= horizon) & (differ[rows, :horizon].mean(1) > SAME_ACTION)
        misled_by = rolled[:0]
        if both.any():
            misled_by = _distances(tokenizer, misled[rows[both], horizon - 1], real[torch.from_numpy(both)])
        metrics[f"varying_error_h{horizon:02d}"] = varying_error(reconstructed, episodes.images[rows, horizon])
        metrics[f"feature_episodes_h{horizon:02d}"] = float(len(rows))
        metrics[f"feature_floor_h{horizon:02d}"] = _ratio(floor, copied)
        tries = episodes.independent[rows]
        for name, top, bottom, groups in (
            ("feature_ratio", rolled, copied, tries), ("other_actions", misled_by, rolled[both], tries[both]),
        ):
            low, high = bootstrap_ratio(top, bottom, groups, seed=0)
            metrics |= {
                f"{name}_h{horizon:02d}": _ratio(top, bottom), f"{name}_low_h{horizon:02d}": low,
                f"{name}_high_h{horizon:02d}": high,
            }
    return metrics


def varying_error(frames: UInt8Array, recorded: UInt8Array) -> float:
    """Squared error of frames (E, H, W, 3) over the variance of the recorded ones, per pixel; of the pixels that vary,
    the quantile WORST; NaN where none varies, or of fewer than ENOUGH episodes.

    0 shows all that differs between the episodes, 1 no more than their mean frame does. Each pixel counts by its own
    variance, so that a small thing counts beside a large one.
    """
    real, shown = (images.reshape(len(images), -1, 3).astype(np.float32) / 255 for images in (recorded, frames))
    errors_N, variances_N = np.square(shown - real).mean((0, -1)), real.var(0).mean(-1)
    varies = variances_N > VARIES**2
    if len(real) < ENOUGH or not varies.any():
        return float("nan")
    return float(np.quantile(errors_N[varies] / variances_N[varies], WORST))


def horizons_of(metrics: Mapping[str, float | None]) -> list[int]:
    """The steps of which picture_metrics holds anything, ascending."""
    return sorted(int(found[1]) for name in metrics if (found := re.fullmatch(r"feature_episodes_h(\d+)", name)))


def worst_varying_step(metrics: Mapping[str, float | None]) -> int | None:
    """The step up to judged_horizon with the largest varying_error; None where it is known at none of them."""
    errors = {step: at_step(metrics, "varying_error", step) for step in range(judged_horizon(metrics) + 1)}
    return max((step for step in errors if np.isfinite(errors[step])), key=lambda step: errors[step], default=None)


def judged_horizon(metrics: Mapping[str, float | None]) -> int:
    """The last step that half of the episodes reach; 0 where nothing was measured."""
    counts = {step: metrics[f"feature_episodes_h{step:02d}"] or 0 for step in horizons_of(metrics)}
    return max((step for step, count in counts.items() if count >= max(counts.values()) / 2), default=0)


def horizon_table(metrics: Mapping[str, float | None]) -> Table:
    """picture_metrics for the terminal, a row for each step."""
    def shown(name: str, step: int) -> str:
        value, low, high = (at_step(metrics, f"{name}{end}", step) for end in ("", "_low", "_high"))
        return decimal(value) + (f" ({low:.2f} to {high:.2f})" if np.isfinite(low) else "")

    columns = ("step", "episodes", "rollout / first frame", "reconstruction / first frame", "other / recorded actions",
               "varying pixels, unexplained")
    return make_table("distance to held-out recordings, by features", columns, (
        (step, int(metrics[f"feature_episodes_h{step:02d}"] or 0), shown("feature_ratio", step),
         shown("feature_floor", step), shown("other_actions", step), shown("varying_error", step))
        for step in horizons_of(metrics)
    ), left=())


def _distances(tokenizer: Tokenizer, frames: UInt8Array, real_ESD: Tensor) -> FloatArray:
    """(E,) of frames, uint8 (E, H, W, 3), to the latents of the recorded ones."""
    distances: FloatArray = (_in_batches(tokenizer.encode, frames) - real_ESD).abs().mean((1, 2)).cpu().numpy()
    return distances


def _in_batches(call: Callable[[Any], Tensor], rows: Any) -> Tensor:
    return torch.cat([call(rows[i : i + BATCH]) for i in range(0, len(rows), BATCH)])


def _ratio(top: FloatArray, bottom: FloatArray) -> float:
    return float(top.mean() / bottom.mean()) if len(bottom) and bottom.mean() > 0 else float("nan")
