"""Learning: what each sampler makes of the same number of model calls."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import torch

from benchmarks.video_rl.clock import clocked
from benchmarks.video_rl.samplers import DiscPlan, LearningPlan, SamplerSetup
from benchmarks.video_rl.sources import DiscSource, TrainingSource
from wm_nodes.core.device import device_of
from wm_nodes.video_model import VideoNetwork
from wm_nodes.video_rl.grpo import GrpoLearner, NothingToLearnError
from wm_nodes.video_rl.reward_hacking import find_hacked_metrics
from wm_nodes.video_rl.train import Request, VideoLearner, post_train, sample_buffers
from wm_nodes.video_rl.training_run import flatten_metrics

MIN_EVALUATIONS = 4


def train_sampler(
    source: TrainingSource[Request], sampler: SamplerSetup, plan: LearningPlan, seed: int,
    on_iteration: Callable[[], object] = lambda: None, learner: VideoLearner | None = None,
) -> dict[str, Any]:
    """Post-train source.network in place; return what that gave: scores of each held-out context before and after,
    means over them (before, every eval_every buffers, and after), a list per quantity of the buffers, and seconds. It
    ends where nothing is left to learn.

    learner: None: a GrpoLearner of the sampler's settings.
    """
    learner = learner or GrpoLearner(source.network, sampler.grpo, sampler.rollout, seed=seed)
    before = after = source.validate()
    evaluations, buffers = [{"iteration": 0, **_means(before)}], list[dict[str, float]]()
    device = device_of(source.network)
    with (
        clocked(source, "request", "sample", "score", device=device) as rollout,
        clocked(learner, "train", device=device) as train,
    ):
        training = post_train(learner, sample_buffers(source, learner, plan.iterations))
        with suppress(NothingToLearnError):  # e.g. every clip succeeds: it would learn no more
            for iteration, (buffer, report) in enumerate(training, 1):
                buffers.append({**flatten_metrics(report), **source.measure(buffer)})
                if iteration % plan.eval_every == 0:
                    after = source.validate()
                    evaluations.append({"iteration": iteration, **_means(after)})
                on_iteration()
    if len(buffers) % plan.eval_every:
        after = source.validate()
        evaluations.append({"iteration": len(buffers), **_means(after)})
    names = dict.fromkeys(name for row in buffers for name in row)  # a buffer that is skipped has no updates
    return {
        "sampler": sampler.name, "shared_noise": sampler.shared_noise, "seed": seed, "plan": asdict(plan),
        "before": before, "after": after, "evaluations": evaluations,
        "buffers": {name: [row.get(name) for row in buffers] for name in names},
        "seconds": {"rollout": rollout[0], "train": train[0]},
    }


def train_on_discs(
    network: VideoNetwork, sampler: SamplerSetup, plan: DiscPlan, seed: int,
    on_iteration: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """train_sampler on the moving disc, and what DD-2 names."""
    row = train_sampler(DiscSource(network, sampler, plan, seed), sampler, plan, seed, on_iteration)
    return {**row, "hacked": hacked(row["evaluations"], plan.proxy)}


def hacked(evaluations: list[dict[str, float]], proxy: str) -> list[str]:
    """Held-out truths that got worse while the training reward rose, DD-2, over all evaluations.

    Worse is less obedience, a mass further from 1 (too much is as wrong as too little), more background error.
    """
    if len(evaluations) < MIN_EVALUATIONS:
        return []
    truths = {
        "obeyed": [row["obeyed"] for row in evaluations],
        "mass": [-abs(row["mass"] - 1) for row in evaluations],
        "background": [-row["background"] for row in evaluations],
    }
    return list(find_hacked_metrics([row[proxy] for row in evaluations], truths))


def _means(scores: Mapping[str, Sequence[float]]) -> dict[str, float]:
    return {name: float(torch.tensor(values, dtype=torch.float64).mean()) for name, values in scores.items()}
