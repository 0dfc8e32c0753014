"""Two ways of training, compared on the same seeds: mean paired difference with Student's 95 % interval."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wm_nodes.core.statistics import MeanInterval, t_interval

PATH = "_path"
"""Ending of a measure that is a mean over the evaluations of a training, its area per model call, and not the last."""
MEASURES = ("reward_path", "reward", "obeyed", "background")
GAINS = ("reward", "task", "obeyed", "mass", "background")
CLIP_MEASURES = ("tracking_path", "tracking", "object_cm", "tool_cm", "psnr_db")


@dataclass(frozen=True)
class SamplerComparison:
    """A sampler against another one on their common seeds."""

    sampler: str
    """Its name."""
    base: str
    """The name of the other."""
    seeds: tuple[int, ...]
    """That both were trained at."""
    differences: dict[str, MeanInterval]
    """One per measure."""


def compare_samplers(
    rows: Sequence[dict[str, Any]], sampler: str, base: str, measures: Sequence[str] = MEASURES
) -> SamplerComparison | None:
    """Compare trainings, whose rows hold `sampler`, `seed`, `plan` and `evaluations`, the first one of before; None
    where the two have fewer than two seeds in common."""
    of = {name: {row["seed"]: row for row in rows if row["sampler"] == name} for name in (sampler, base)}
    seeds = sorted(of[sampler].keys() & of[base].keys())
    if len(seeds) < 2:
        return None
    differences = {
        measure: t_interval([value(of[sampler][seed], measure) - value(of[base][seed], measure) for seed in seeds])
        for measure in measures
    }
    return SamplerComparison(sampler, base, tuple(seeds), differences)


def gains(rows: Sequence[dict[str, Any]], measure: str) -> list[list[float]]:
    """Of each training, every evaluation of one measure less the first, the one before training."""
    courses = ([point[measure] for point in row["evaluations"]] for row in rows)
    return [[reached - course[0] for reached in course] for course in courses]


def value(row: dict[str, Any], measure: str) -> float:
    """One number of one training, e.g. `reward`, or `reward_path`; see PATH. One that ended early, as nothing was left
    to learn, stays what it was by then."""
    evaluations, name = row["evaluations"], measure.removesuffix(PATH)
    last = float(evaluations[-1][name])
    if name == measure:
        return last
    reached, planned = [evaluation[name] for evaluation in evaluations[1:]], row["plan"]
    missing = -(-planned["iterations"] // planned["eval_every"]) - len(reached)
    return float(np.mean([*reached, *[last] * missing]))
