"""The outcome task: the video model chooses the motion, and is rewarded by how the clip ends. Every arm on one learner,
on held-out first frames, with scores that nothing was trained on.
"""

import argparse
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from benchmarks.video_rl import plots, tables
from benchmarks.video_rl.judged import JudgedContexts, open_judge
from benchmarks.video_rl.learning import train_sampler
from benchmarks.video_rl.samplers import LearningPlan, SamplerSetup, outcome_samplers
from benchmarks.video_rl.sources import TASK, config_of, reward_spread
from benchmarks.video_rl.trainings import (
    add_training_options,
    against_cps,
    compare,
    draw,
    load_recordings,
    row_name,
    train_all,
    with_rate,
    write_trainings,
)
from benchmarks.video_rl.trials import SamplerTrial
from wm_nodes.apps.options import prepare_torch
from wm_nodes.config.load import judge_or_embedded, load_config, load_video_config
from wm_nodes.config.schema import AGENT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.files import write_atomic
from wm_nodes.core.progress import tqdm
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.service import buffer_jobs, clip_fps
from wm_nodes.training.weights import load_weights_file, pack_weights
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_model.success_reader import load_success_reader
from wm_nodes.video_rl.heldout_metrics import Yardstick, make_yardstick, measure_clips, measure_executability
from wm_nodes.video_rl.reference_reward import load_probe, score_clips
from wm_nodes.video_rl.sampling import ClipGenerator
from wm_nodes.world_model.position_probe import PositionProbe

MEASURES = ("success_path", "success", "outcome", "scenery")
SCORES = ("success", "outcome", "scenery")
METRICS = (
    "success", "reader_success", "executed_success", "executed_object_cm", "object_permanence", "ghost_motion",
    "impossible_tool_steps", "scenery_change",
)
MEASURED = 100
console = Console()


@dataclass(frozen=True)
class OutcomePlan(LearningPlan):
    """rewards: weight by name. rubric: of the judge, where `agent` is among them."""

    iterations: int = 15
    contexts: int = 8
    eval_contexts: int = 200
    eval_every: int = 3
    rewards: tuple[tuple[str, float], ...] = (("outcome", 1.0),)
    rubric: str = "robot"


class OutcomeSource(JudgedContexts):
    """First frames of recorded episodes; `heldout` are others. fps: of the clips."""

    def __init__(
        self, folder: VideoFolder, contexts: Clips, heldout: Clips, probe: PositionProbe, sampler: SamplerSetup,
        plan: OutcomePlan, seed: int, fps: float,
    ) -> None:
        config = config_of(sampler, plan, seed, "outcome", dict(plan.rewards))
        config = config.with_values(judge=judge_or_embedded(config.judge.with_values(rubric=plan.rubric)))
        super().__init__(folder, contexts, config, probe, fps)
        self.network, self._heldout = folder.network, heldout

    def measure(self, buffer: RolloutBuffer) -> dict[str, float]:
        return {"rollout_reward_std": reward_spread(buffer)}

    def validate(self) -> Mapping[str, list[float]]:
        self.folder.network.eval()
        frames = self.evaluate(self._heldout, self.config.evaluation.num_steps)
        scores = score_clips(frames, self._heldout, self.probe, self.folder.clip["num_conditioning"]).named()
        return {name: scores[name].tolist() for name in SCORES}


def add_options(outcome: argparse.ArgumentParser) -> None:
    add_training_options(outcome, OutcomePlan, "video_model_outcome", range(3))
    outcome.add_argument("--weights", type=Path, metavar="FOLDER", help="keep the trained weights here")


def run(arguments: argparse.Namespace) -> None:
    """Train every arm at every seed; compare; measure what was kept in --weights."""
    base = load_video_folder(arguments.video_model, arguments.device)
    plan = OutcomePlan(arguments.iterations, eval_contexts=arguments.eval_contexts)
    arms = with_rate(outcome_samplers(), arguments.learning_rate)
    trials = [SamplerTrial(arm, plan) for arm in arms] + [judge_trial(arms[0], plan)]
    of = {"sha256": base.manifest["sha256"]}
    rows = train_all(arguments, trials, partial(_train, arguments), of, arguments.workers)
    if arguments.weights:
        _measure_all(arguments, trials, rows, of)
    comparisons = compare(arguments, trials, rows, against_cps(rows), of, MEASURES)
    draw(arguments, plots.plot_courses, rows, SCORES)
    console.print(tables.gain_table(rows, SCORES), tables.comparison_table(comparisons))
    if arguments.weights:
        console.print(tables.measured_table(rows))
        if arguments.json is not None:
            plots.plot_proxy(rows, arguments.json.with_name(f"{arguments.json.stem}_proxy.png"))


def judge_trial(sampler: SamplerSetup, plan: OutcomePlan) -> SamplerTrial[OutcomePlan]:
    """The same sampler, paid by the embedded judge alone."""
    judged = replace(plan, rewards=((AGENT, 1.0),))
    return SamplerTrial(replace(sampler, name=f"{sampler.name}, judge {plan.rubric}"), judged)


def _train(
    arguments: argparse.Namespace, trial: SamplerTrial[OutcomePlan], seed: int, on_iteration: Callable[[], object]
) -> dict[str, Any]:
    folder = load_video_folder(arguments.video_model, arguments.device)
    contexts, heldout = load_recordings(arguments, folder, trial.plan.eval_contexts)
    probe = load_probe(shipped_model(TASK), arguments.device)
    fps = clip_fps(arguments.context_bags[0], folder.clip["stride"])
    with OutcomeSource(folder, contexts, heldout, probe, trial.sampler, trial.plan, seed, fps) as source:
        row = train_sampler(source, trial.sampler, trial.plan, seed, on_iteration)
    if arguments.weights:
        write_atomic(_weights(arguments, row), pack_weights(folder.network).data)
    return {name: value for name, value in row.items() if name not in ("before", "after")}


def _weights(arguments: argparse.Namespace, row: Mapping[str, Any]) -> Path:
    """Where the weights of a training are kept."""
    return Path(arguments.weights / f"{row_name(row)}.safetensors")


def _measure_all(
    arguments: argparse.Namespace, trials: list[SamplerTrial[OutcomePlan]], rows: list[dict[str, Any]],
    of: dict[str, Any],
) -> None:
    """Add to each row what measure_weights finds, `measured_before` and `measured_after`, where it is missing."""
    todo = [row for row in rows if "measured_after" not in row]
    before = {row["seed"]: row["measured_before"] for row in rows if "measured_before" in row}
    with (
        ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn"), initializer=prepare_torch) as pool,
        tqdm(total=len(todo), desc="held-out metrics", unit="training") as bar,
    ):
        bases = {
            seed: pool.submit(measure_weights, arguments, None, seed)
            for seed in dict.fromkeys(row["seed"] for row in todo) if seed not in before
        }
        trained = {pool.submit(measure_weights, arguments, _weights(arguments, row), row["seed"]): row for row in todo}
        for future in as_completed(trained):
            row = trained[future]
            seed = row["seed"]
            row["measured_before"] = before[seed] if seed in before else bases[seed].result()
            row["measured_after"] = future.result()
            bar.update()
            write_trainings(arguments, trials, rows, [], of)


@cache
def _yardstick(video_model: Path, heldout_bags: tuple[Path, ...], device: torch.device) -> tuple[Clips, Yardstick]:
    """The first MEASURED held-out recordings, and what clips are measured with, of all of them."""
    folder, probe = load_video_folder(video_model, device), load_probe(shipped_model(TASK), device)
    recordings, reader = load_clips(heldout_bags, folder.clip["stride"]), load_success_reader(video_model, TASK)
    by = make_yardstick(folder.codec, recordings, probe, reader, load_config("cpu", {"task": TASK}).simulation)
    return recordings.select(torch.arange(len(recordings))[:MEASURED]), by


def measure_weights(arguments: argparse.Namespace, weights: Path | None, seed: int) -> dict[str, float]:
    """Return means over the first MEASURED held-out first frames of metrics that were never trained on, of one ODE clip
    each from the noise of `seed`: success by two readers and in the simulator, faults; `accepted`: as a success by the
    embedded judge, `accepted_executed`: and a success in the simulator, too. weights: None: the base's.

    Raises:
        OSError: no weights are kept.
    """
    heldout, by = _yardstick(arguments.video_model, tuple(arguments.heldout_bags), arguments.device)
    folder = load_video_folder(arguments.video_model, arguments.device)
    config = load_video_config("outcome", {"seed": seed})
    if weights is not None:
        load_weights_file(folder.network, weights)
    frames = ClipGenerator(folder, heldout, config).evaluate(heldout, config.evaluation.num_steps)
    positions, given = by.probe.read(frames), folder.clip["num_conditioning"]
    metrics = measure_clips(frames, positions, heldout, by, given)
    metrics |= measure_executability(positions, heldout, by, folder.clip["stride"])
    accepted = _accepted(frames, heldout, config.with_values(judge=judge_or_embedded(config.judge)), given, arguments)
    executed = metrics["executed_success"].numpy() * accepted
    shares = {"accepted": float(accepted.mean()), "accepted_executed": float(executed.mean())}
    return {name: float(metrics[name].mean()) for name in METRICS} | shares


def _accepted(
    frames: Tensor, heldout: Clips, config: VideoRlConfig, given: int, arguments: argparse.Namespace
) -> FloatArray:
    """1 where the judge takes a decoded clip for a success, (N,)."""
    fps = clip_fps(arguments.heldout_bags[0], config.model.stride)
    jobs = buffer_jobs(frames, heldout, "0" * 64, config, given=given, fps=fps)
    with closing(open_judge(config, heldout, fps)) as judge:
        return np.array([accepts(verdict) is True for verdict in judge.judge(jobs)], np.float32)
