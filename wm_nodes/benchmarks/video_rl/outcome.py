"""The outcome task: the video model chooses the motion, and is rewarded by how the clip ends. Every arm on one learner,
on held-out first frames, with scores that nothing was trained on.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from benchmarks.video_rl import plots, tables
from benchmarks.video_rl.learning import train_sampler
from benchmarks.video_rl.samplers import LearningPlan, SamplerSetup, outcome_samplers
from benchmarks.video_rl.sources import TASK, config_of
from benchmarks.video_rl.trainings import against_cps, compare, draw, train_all
from benchmarks.video_rl.trials import SamplerTrial
from wm_nodes.apps.options import add_device, add_json, positive
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.files import write_atomic
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_rl.reference_reward import load_probe, score_clips
from wm_nodes.video_rl.sampling import RecordedContexts
from wm_nodes.world_model.position_probe import PositionProbe

MEASURES = ("success_path", "success", "outcome", "scenery")
SCORES = ("success", "outcome", "scenery")
console = Console()


@dataclass(frozen=True)
class OutcomePlan(LearningPlan):
    """rewards: weight by name."""

    iterations: int = 15
    contexts: int = 8
    eval_contexts: int = 200
    eval_every: int = 3
    rewards: tuple[tuple[str, float], ...] = (("outcome", 1.0),)


class OutcomeSource(RecordedContexts):
    """First frames of recorded episodes; `heldout` are others."""

    def __init__(
        self, folder: VideoFolder, contexts: Clips, heldout: Clips, probe: PositionProbe, sampler: SamplerSetup,
        plan: OutcomePlan, seed: int,
    ) -> None:
        super().__init__(folder, contexts, config_of(sampler, plan, seed, "outcome", dict(plan.rewards)), probe)
        self.network = folder.network
        self._heldout = heldout.select(torch.arange(min(plan.eval_contexts, len(heldout))))

    def measure(self, buffer: RolloutBuffer) -> dict[str, float]:
        spread = buffer.rewards["total"].view(-1, self.config.groups.group_size).std(1, correction=0)
        return {"rollout_reward_std": float(spread.mean())}

    def validate(self) -> Mapping[str, list[float]]:
        self.folder.network.eval()
        frames = self.evaluate(self._heldout, self.config.evaluation.num_steps)
        scores = score_clips(frames, self._heldout, self.probe, self.folder.clip["num_conditioning"]).named()
        return {name: scores[name].tolist() for name in SCORES}


def add_options(outcome: argparse.ArgumentParser) -> None:
    outcome.add_argument("--iterations", type=positive, default=OutcomePlan.iterations)
    outcome.add_argument("--eval-contexts", type=positive, default=OutcomePlan.eval_contexts)
    outcome.add_argument("--video-model", type=Path, default=shipped_model(TASK) / "video_model_outcome")
    outcome.add_argument("--context-bags", type=Path, nargs="+", required=True, metavar="BAG")
    outcome.add_argument("--heldout-bags", type=Path, nargs="+", required=True, metavar="BAG")
    outcome.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    outcome.add_argument("--samplers", "--arms", nargs="+", metavar="NAME")
    outcome.add_argument("--learning-rate", type=float, help="of every arm, to choose one; default: the chosen ones")
    outcome.add_argument("--workers", type=positive, default=1, help="trainings at the same time, a process each")
    outcome.add_argument("--weights", type=Path, metavar="FOLDER", help="keep the trained weights here")
    add_device(outcome)
    add_json(outcome, "write every row here; trainings go on where the file stops")


def run(arguments: argparse.Namespace) -> None:
    """Train every arm at every seed; compare."""
    base = load_video_folder(arguments.video_model, arguments.device)
    plan = OutcomePlan(arguments.iterations, eval_contexts=arguments.eval_contexts)
    arms = outcome_samplers()
    if arguments.learning_rate:
        arms = [replace(arm, grpo=arm.grpo.with_values(learning_rate=arguments.learning_rate)) for arm in arms]
    trials = [SamplerTrial(arm, plan) for arm in arms]
    of = {"sha256": base.manifest["sha256"]}
    rows = train_all(arguments, trials, partial(_train, arguments), of, arguments.workers)
    comparisons = compare(arguments, trials, rows, against_cps(rows), of, MEASURES)
    draw(arguments, plots.plot_courses, rows, SCORES)
    console.print(tables.gain_table(rows, SCORES), tables.comparison_table(comparisons))


def _train(
    arguments: argparse.Namespace, trial: SamplerTrial[OutcomePlan], seed: int, on_iteration: Callable[[], object]
) -> dict[str, Any]:
    folder = load_video_folder(arguments.video_model, arguments.device)
    bags = arguments.context_bags, arguments.heldout_bags
    contexts, heldout = (load_clips(some, folder.clip["stride"]) for some in bags)
    probe = load_probe(shipped_model(TASK), arguments.device)
    source = OutcomeSource(folder, contexts, heldout, probe, trial.sampler, trial.plan, seed)
    row = train_sampler(source, trial.sampler, trial.plan, seed, on_iteration)
    if arguments.weights:
        name = f"{trial.sampler.name.replace(' ', '_').replace(',', '')}_{seed}.safetensors"
        write_atomic(arguments.weights / name, pack_weights(folder.network).data)
    return {name: value for name, value in row.items() if name not in ("before", "after")}
