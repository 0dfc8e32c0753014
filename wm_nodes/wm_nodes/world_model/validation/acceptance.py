"""Whether a world model passes acceptance: measured on held-out real episodes, before a policy is trained in it
(RS-12).

The numbers come from open_loop.py: recorded actions rolled out open-loop from recorded first frames. Positions
are read off the imagined pictures by the judge's own probe; "copying" reads them off the first frame instead.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import get_task, parts_of
from wm_nodes.core.statistics import newcombe_difference
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.reports.console_table import make_table
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.validation.open_loop import MOVED_M, evaluate_rollouts

MORE_TRAINING = (
    "train longer (world_model.num_iterations) or on more episodes near contact (data.num_episodes, data.behaviours)"
)
MORE_NEAR_MISSES = "collect more near misses (data.behaviours.near_miss), or raise reward.success_threshold"
MORE_SUCCESSES = "collect more successes (data.behaviours), or lower reward.success_threshold"
POLICY_DATA = "refresh the model with more episodes of weak policies (data.policy_episodes)"


@dataclass(frozen=True)
class Criterion:
    """passed: value against threshold, as `rule` says. remedy: what to do where it failed.

    value: NaN where it could not be computed; that fails. threshold: None where `rule` says everything.
    """

    name: str
    value: float
    threshold: float | None
    rule: str
    passed: bool
    remedy: str


@dataclass(frozen=True)
class AcceptanceReport:
    """metrics: every number of the rollouts, by the names in docs/metrics.md. notes: what was measured and left out."""

    task: str
    episodes: int
    criteria: tuple[Criterion, ...]
    metrics: dict[str, float]
    notes: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        return all(criterion.passed for criterion in self.criteria)

    @property
    def failed(self) -> tuple[str, ...]:
        return tuple(criterion.name for criterion in self.criteria if not criterion.passed)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, numbers that are not finite as None; with `passed` and `failed`."""
        values = asdict(self)
        values["criteria"] = [{**row, "value": _finite(row["value"])} for row in values["criteria"]]
        values["metrics"] = {name: _finite(value) for name, value in self.metrics.items()}
        return {**values, "passed": self.passed, "failed": list(self.failed)}

    def table(self) -> Table:
        """The criteria for the terminal; remedies where they failed."""
        words = "passed" if self.passed else "FAILED"
        rows = []
        for row in self.criteria:
            limit = "" if row.threshold is None else f" {row.threshold:g}"
            value = f"{row.value:.3f}" if math.isfinite(row.value) else "undefined"
            mark = "[green]passed" if row.passed else f"[red]failed[/]: {row.remedy}"
            rows.append((row.name, value, row.rule + limit, mark))
        title = f"acceptance {words}: {self.task}, {self.episodes} held-out real episodes"
        columns, caption = ("criterion", "value", "must be", ""), "\n".join(self.notes) or None
        return make_table(title, columns, rows, left=("criterion", "must be", ""), caption=caption)


def model_metrics(models: WorldModels, heldout: EpisodeArrays, config: RunConfig) -> dict[str, float]:
    """Return the metrics of rollouts of held-out actions against the recordings; see open_loop.evaluate_rollouts."""
    threshold = config.reward.success_threshold
    return evaluate_rollouts(models.tokenizer, models.action, heldout, threshold=threshold, probe=models.probe)


def accept_world_model(
    models: WorldModels, heldout: EpisodeArrays, config: RunConfig, imagined: tuple[int, int] | None = None,
    real: tuple[int, int] | None = None,
) -> AcceptanceReport:
    """Measure whether a world model passes acceptance for config.task.

    Args:
        heldout: real episodes with ground truth that the model was not trained on.
        imagined, real: (successes, episodes) of the SFT policy in the model and in the simulator; None: not measured.

    Raises:
        ValueError: episodes without ground truth, or labelled for other tasks than the model's.
    """
    _check(models, heldout, config.task)
    metrics = model_metrics(models, heldout, config)
    criteria, notes = apply_criteria(metrics, config, heldout.num_steps, imagined, real)
    return AcceptanceReport(config.task, len(heldout), criteria, metrics, notes)


def apply_criteria(
    metrics: Mapping[str, float], config: RunConfig, num_steps: int, imagined: tuple[int, int] | None,
    real: tuple[int, int] | None,
) -> tuple[tuple[Criterion, ...], tuple[str, ...]]:
    """Return criteria and notes from the metrics of rollouts of up to num_steps steps; see accept_world_model."""
    limits, task = config.acceptance, config.task
    notes = [
        f"Errors are those of the full horizon over those of copying the first frame; the object's over the episodes "
        f"in which it moved more than {100 * MOVED_M:g} cm; the probe alone errs by "
        f"{_at(metrics, 'object_floor_cm', num_steps):.2f} cm (object) and "
        f"{_at(metrics, 'tool_floor_cm', num_steps):.2f} cm (tool) on real frames."
    ]
    criteria = []
    if not get_task(task).moves_object:
        notes.append(f"The object hardly moves in {task}, so its error is not judged; the tool's is.")
    else:
        ratio = _at(metrics, "object_moved_ratio", num_steps)
        criteria.append(_below(f"object error / copying, step {num_steps}", ratio, limits.object_error_ratio))
    ratio = _at(metrics, "tool_ratio", num_steps)
    criteria.append(_below(f"tool error / copying, step {num_steps}", ratio, limits.tool_error_ratio))
    for kind, threshold, remedy in (
        ("precision", limits.done_precision, MORE_NEAR_MISSES), ("recall", limits.done_recall, MORE_SUCCESSES),
    ):
        found = [metrics.get(f"done_{part}_{kind}", math.nan) for part in parts_of(task)]
        value = float(np.nanmean(found)) if np.isfinite(found).any() else math.nan
        name = f"done {kind} on rollouts" + (", mean of the tasks" if len(found) > 1 else "")
        criteria.append(Criterion(name, value, threshold, ">=", value >= threshold, remedy))
    if not limits.require_success_agreement:
        notes.append("Agreement of imagined and real success was not asked for (acceptance.require_success_agreement).")
    elif imagined is None or real is None:
        notes.append("Agreement of imagined and real success was not judged: no policy was measured in both.")
    else:
        criteria.append(_agreement(imagined, real))
    return tuple(criteria), tuple(notes)


def accept_success_agreement(task: str, imagined: tuple[int, int], real: tuple[int, int]) -> AcceptanceReport:
    """Judge a model that cannot be rolled out as accept_world_model does, by (successes, episodes) in both alone."""
    notes = ("Errors of the frames were not judged: the model is no world model.",)
    return AcceptanceReport(task, 0, (_agreement(imagined, real),), {}, notes)


def _agreement(imagined: tuple[int, int], real: tuple[int, int]) -> Criterion:
    low, high = newcombe_difference(*imagined, *real)
    gap = imagined[0] / imagined[1] - real[0] / real[1]
    name = f"SFT policy: imagined {imagined[0]}/{imagined[1]} - real {real[0]}/{real[1]} success"
    rule = f"0 inside its 95 % interval, {low:+.2f} to {high:+.2f}"
    return Criterion(name, gap, None, rule, bool(low <= 0 <= high), POLICY_DATA)


def _below(name: str, value: float, threshold: float) -> Criterion:
    return Criterion(name, float(value), threshold, "<=", bool(value <= threshold), MORE_TRAINING)


def _at(metrics: Mapping[str, float], name: str, step: int) -> float:
    """The metric at a step; NaN where no episode was that long."""
    return float(metrics.get(f"{name}_h{step:02d}", float("nan")))


def _check(models: WorldModels, heldout: EpisodeArrays, task: str) -> None:
    for part in parts_of(task):
        models.task_index(part)
    if heldout.tasks != models.tasks:
        raise ValueError(
            f"held-out episodes are labelled for {', '.join(heldout.tasks)}, the world model knows "
            f"{', '.join(models.tasks)}; stack them with the tasks of the model's manifest"
        )
    unknown = int(np.isnan(heldout.ground_truth).reshape(len(heldout), -1).any(1).sum())
    if heldout.ground_truth.shape[-1] == 0 or unknown:
        raise ValueError(
            f"{unknown or len(heldout)} of {len(heldout)} held-out episodes carry no ground truth, so positions cannot "
            "be compared; measure on simulator episodes (environments/record.py), not on imagined or real-robot ones"
        )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
