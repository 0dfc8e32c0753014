"""The world model's own reward: goal distance plus done signal (RS-5, RS-7, RS-8). Shapes: N environments, K frames."""

from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.schema import RewardConfig
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.reward.base import (
    SUCCESS_NO,
    SUCCESS_UNKNOWN,
    SUCCESS_YES,
    RewardInput,
    RewardResult,
    assemble,
    version_of,
)
from wm_nodes.reward.distances import Distance

_Array = TypeVar("_Array", NDArray[Any], Tensor)


class EndogenousReward:
    """r = w_d r^d + w_s r^s (RS-8).

    Dense (RS-5), with Phi(x) = 1 - Perc(x, goal):
        delta: Phi(x_{t+1}) - Phi(x_t), clipped above: pays for coming closer, nothing for staying close, and no way
            back to where it began is paid.
        abs: Phi(x_{t+1}), not clipped: its level is the signal.
        progress: index of the nearest golden frame over that of the goal, difference over the step, clipped above.
    Sparse (RS-7): 1 where the done signal is strictly above the threshold; nothing above the uncertainty limit. It is
    paid once because the environment terminates on the crossing and later steps are invalid.

    A goal is needed only while dense_weight > 0; without one the step is invalid, never worth 0.
    """

    def __init__(self, config: RewardConfig, distance: Distance) -> None:
        self._config, self._distance = config, distance

    @property
    def name(self) -> str:
        return "endogenous"

    @property
    def version(self) -> int:
        differences = self._config.dense_weight > 0 and self._config.mode != "abs"
        clipped = ["clipped above"] if differences else []  # the rule of what is paid
        return version_of(self.name, self._config.model_dump_json(), self._distance.name, *clipped)

    @property
    def config(self) -> RewardConfig:
        return self._config

    @property
    def distance(self) -> Distance:
        return self._distance

    def evaluate(self, step: RewardInput) -> RewardResult:
        config = self._config
        dense = np.zeros(len(step.images), np.float32)
        reasons: dict[str, BoolArray] = {}
        if config.dense_weight > 0:
            dense, missing = self._dense(step)
            what = "golden trajectory" if config.mode == "progress" else "goal"
            reasons[f"no {what}"] = missing
        unknown = ~np.isfinite(step.success_probability) | ~np.isfinite(step.uncertainty)
        reasons["success probability or uncertainty is not finite"] = unknown
        crossed = self.crossed(step.success_probability, step.uncertainty)
        success = np.where(unknown, SUCCESS_UNKNOWN, np.where(crossed, SUCCESS_YES, SUCCESS_NO)).astype(np.uint8)
        return assemble(
            np.float32(config.dense_weight) * dense, np.float32(config.sparse_weight) * crossed.astype(np.float32),
            step, success, reasons, {"dense": config.dense_weight, "sparse": config.sparse_weight},
        )

    def crossed(self, signal: _Array, uncertainty: _Array) -> _Array:
        """Where the sparse reward is paid (bool), of arrays or of tensors."""
        crossed = signal > self._config.success_threshold
        if self._config.uncertainty_limit > 0:
            crossed = crossed & (uncertainty <= self._config.uncertainty_limit)
        return crossed

    def approach(self, before: _Array, after: _Array) -> _Array:
        """The unweighted dense reward of how near the step began and ended: 1 - distance to the goal, or with mode
        progress progress_along; arrays or tensors."""
        if self._config.mode == "abs":
            return after
        clipped: _Array = (after - before).clip(max=self._config.dense_clip)
        return clipped

    def _dense(self, step: RewardInput) -> tuple[FloatArray, BoolArray]:
        """Return unweighted dense rewards (N,) and where the goal is missing; rewards are 0 there and where invalid."""
        count = len(step.images)
        reference = step.golden if self._config.mode == "progress" else step.goals
        if reference is None:
            return np.zeros(count, np.float32), np.ones(count, np.bool_)
        has_goal = np.ones(count, np.bool_) if step.goal_found is None else step.goal_found
        rows = np.flatnonzero(step.valid & has_goal)
        dense = np.zeros(count, np.float32)
        if len(rows):
            dense[rows] = self._progress(step, rows) if self._config.mode == "progress" else self._goal(step, rows)
        return dense, ~has_goal

    def _goal(self, step: RewardInput, rows: NDArray[np.intp]) -> FloatArray:
        assert step.goals is not None  # checked by _dense
        goals = step.goals[rows]
        after = self._distance(step.next_images[rows], goals)
        before = after if self._config.mode == "abs" else self._distance(step.images[rows], goals)
        return self.approach(1 - before, 1 - after)

    def _progress(self, step: RewardInput, rows: NDArray[np.intp]) -> FloatArray:
        assert step.golden is not None and step.golden_lengths is not None  # checked by _dense and RewardInput
        golden, lengths = step.golden[rows], torch.from_numpy(step.golden_lengths[rows])
        num_frames = golden.shape[1]
        frames = golden.reshape(-1, *golden.shape[2:])
        distances = (
            torch.from_numpy(self._distance(np.repeat(images[rows], num_frames, axis=0), frames)).view(-1, num_frames)
            for images in (step.images, step.next_images)
        )
        return self.approach(*(progress_along(each, lengths) for each in distances)).numpy()


def progress_along(distances: Tensor, lengths: Tensor) -> Tensor:
    """Index of the nearest golden frame over that of the goal, float32 (...,) in [0, 1].

    Args:
        distances: to the golden frames (..., K). lengths: how many of them count, int64 (...,).
    """
    beyond = torch.arange(distances.shape[-1], device=distances.device) >= lengths.unsqueeze(-1)
    return distances.masked_fill(beyond, torch.inf).argmin(-1) / (lengths - 1)
