"""The outcome task: the video model chooses the motion, and is rewarded by how the clip ends. Every arm on one learner,
on held-out first frames, with scores that nothing was trained on.
"""

from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from benchmarks.experiment import Count, console
from benchmarks.video_rl import tables
from benchmarks.video_rl.comparison import SamplerComparison
from benchmarks.video_rl.judged import JudgedContexts, open_judge
from benchmarks.video_rl.learning import train_sampler
from benchmarks.video_rl.proxy_plot import plot_proxy
from benchmarks.video_rl.samplers import LearningPlan, SamplerSetup, outcome_samplers, paper_samplers
from benchmarks.video_rl.sources import TASK, config_of
from benchmarks.video_rl.spread import group_spread
from benchmarks.video_rl.trainings import OnIteration, RecordedTrainings, training_name
from benchmarks.video_rl.trials import PAPER_GROUP, SamplerTrial
from wm_nodes.apps.options import prepare_torch
from wm_nodes.config.load import judge_or_embedded, load_config, load_video_config
from wm_nodes.config.schema import AGENT, EXECUTION
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.files import file_sha256
from wm_nodes.core.progress import tqdm
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.service import buffer_jobs, clip_fps
from wm_nodes.training.weights import load_weights_file, save_weights
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_model.success_reader import load_success_reader
from wm_nodes.video_rl.execution_reward import make_execution_reward
from wm_nodes.video_rl.heldout_metrics import Yardstick, make_yardstick, measure_clips, measure_executability
from wm_nodes.video_rl.reference_reward import load_probe, score_clips
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.world_model.position_probe import PositionProbe

MEASURES = ("success_path", "success", "outcome", "scenery")
SCORES = ("success", "outcome", "scenery")
METRICS = (
    "success", "reader_success", "executed_success", "executed_object_cm", "object_permanence", "impossible_tool_steps",
)
MEASURED = 100


@dataclass(frozen=True)
class OutcomePlan(LearningPlan):
    """What pays, beside how long a training is."""

    iterations: int = 15
    """Buffers."""
    contexts: int = 8
    """First frames of a buffer."""
    eval_contexts: int = 200
    """Held-out first frames."""
    eval_every: int = 3
    """Buffers."""
    rewards: tuple[tuple[str, float], ...] = (("outcome", 1.0),)
    """Weight by name."""
    rubric: str = "robot"
    """Of the judge, where `agent` is among the rewards."""


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
        return group_spread(buffer, self.config.groups.group_size)

    def validate(self) -> Mapping[str, list[float]]:
        self.folder.network.eval()
        frames = sample_by_ode(self.folder, self._heldout, self.config, self.config.evaluation.num_steps)
        scores = score_clips(frames, self._heldout, self.probe, self.folder.clip["num_conditioning"])
        return {name: scores[name].tolist() for name in SCORES}


@dataclass(kw_only=True)
class Outcome(RecordedTrainings[OutcomePlan]):
    """A video model that chooses the motion, rewarded by how the clip ends: every arm on one learner."""

    video_model: Path = shipped_model(TASK) / "video_model_outcome"
    """Folder that training begins with."""
    iterations: Count = OutcomePlan.iterations
    """Buffers of each training."""
    eval_contexts: Count = OutcomePlan.eval_contexts
    """Held-out first frames."""
    weights: Path | None = None
    """Keep the trained weights in this folder, and measure them by what nothing was trained on."""
    measure_every: Count | None = None
    """Buffers between weights that are kept and measured; without, those after the last one only."""

    measures: ClassVar = MEASURES

    def trials(self) -> list[SamplerTrial[OutcomePlan]]:
        plan = OutcomePlan(self.iterations, eval_contexts=self.eval_contexts)
        arms = self.with_rate(outcome_samplers())
        return [*(SamplerTrial(arm, plan) for arm in arms), *paid_trials(arms[0], plan)]

    def train(self, trial: SamplerTrial[OutcomePlan], seed: int, on_iteration: OnIteration) -> dict[str, Any]:
        folder = self.folder()
        contexts, heldout = self.recordings(folder, trial.plan.eval_contexts)
        probe, fps = load_probe(shipped_model(TASK), self.where), clip_fps(self.context_bags[0], folder.clip["stride"])
        buffers, kept = count(1), dict[str, str]()

        def keep(trained: int) -> None:
            if self.weights and trained in self.measured(trial.plan):
                path = self.weights / weights_name(trial.sampler.name, seed, trained)
                kept[str(trained)] = save_weights(folder.network, path).sha256

        def after_buffer() -> None:
            keep(next(buffers))
            on_iteration()

        with OutcomeSource(folder, contexts, heldout, probe, trial.sampler, trial.plan, seed, fps) as source:
            row = train_sampler(source, trial.sampler, trial.plan, seed, after_buffer)
        for left in range(next(buffers), trial.plan.iterations + 1):  # nothing was left to learn
            keep(left)
        return {name: value for name, value in row.items() if name not in ("before", "after")} | {"weights": kept}

    def measured(self, plan: OutcomePlan) -> list[int]:
        """After which buffers weights are measured."""
        return sorted({*range(0, plan.iterations, self.measure_every or plan.iterations), plan.iterations} - {0})

    def train_all(self) -> list[dict[str, Any]]:
        """The rows; where weights are kept with `measured`, what measure_weights finds, by the number of buffers."""
        rows = super().train_all()
        if not self.weights:
            return rows
        plans = {trial.sampler.name: trial.plan for trial in self.trials()}
        todo = defaultdict[tuple[Path | None, int], list[tuple[dict[str, Any], str]]](list)
        for row in rows:
            name, seed = row["sampler"], row["seed"]
            for buffers in (0, *self.measured(plans[name])):
                if str(buffers) not in row.setdefault("measured", {}):
                    weights = kept_weights(self.weights, row, buffers) if buffers else None
                    todo[weights, seed].append((row["measured"], str(buffers)))
        with (
            ProcessPoolExecutor(self.workers, mp_context=get_context("spawn"), initializer=prepare_torch) as pool,
            tqdm(total=len(todo), desc="held-out metrics", unit="model") as bar,
        ):
            running = {pool.submit(self.measure_weights, *model): places for model, places in todo.items()}
            for future in as_completed(running):
                for measured, at in running[future]:
                    measured[at] = future.result()
                bar.update()
                self.write_rows(rows)
        return rows

    def show(self, rows: list[dict[str, Any]], comparisons: list[SamplerComparison]) -> None:
        console.print(tables.gain_table(rows, SCORES), tables.comparison_table(comparisons))
        if self.weights:
            console.print(tables.measured_table(rows))
            if self.json is not None:
                plot_proxy(rows, self.json.with_name(f"{self.json.stem}_proxy.png"))

    def heldout_config(self, seed: int) -> VideoRlConfig:
        """How the clips of measure_weights are made."""
        return load_video_config("outcome", {"seed": seed})

    def measure_weights(self, weights: Path | None, seed: int) -> dict[str, float]:
        """Return means over the first MEASURED held-out first frames of metrics that were never trained on, of one ODE
        clip each from the noise of `seed`: success by two readers and in the simulator, faults; `accepted`: as a
        success by the embedded judge, `execution_success`: by the action world model, `..._executed`: and a success in
        the simulator, too. weights: None: the base's.

        Raises:
            OSError: no weights are kept.
        """
        heldout, by = _yardstick(self.video_model, self.heldout_bags, self.where)
        folder, config = self.folder(), self.heldout_config(seed)
        if weights is not None:
            load_weights_file(folder.network, weights)
        frames = sample_by_ode(folder, heldout, config, config.evaluation.num_steps)
        positions, given = by.probe.read(frames), folder.clip["num_conditioning"]
        metrics = measure_clips(frames, positions, heldout, by, given)
        metrics |= measure_executability(positions, heldout, by, folder.clip["stride"])
        config = config.with_values(judge=judge_or_embedded(config.judge))
        fps = clip_fps(self.heldout_bags[0], config.model.stride)
        imagined = make_execution_reward(config, folder, heldout, by.probe).score(frames, heldout)
        done = {"accepted": torch.from_numpy(_accepted(frames, heldout, config, given, fps)),
                "execution_success": imagined["execution_success"]}
        shares = done | {f"{name}_executed": some * metrics["executed_success"] for name, some in done.items()}
        return {name: float(values.mean()) for name, values in ({n: metrics[n] for n in METRICS} | shares).items()}


@dataclass(kw_only=True)
class AsWritten(Outcome):
    """The paper's settings (Table 5) on the outcome task, paid by the action world model: DynDiff beside other samplers
    at equal model calls, and CPS at equal noise. In a window 4 of 15 steps train, elsewhere 8: 7,168 instead of 10,240
    forward passes a buffer, one that trains counted as three."""

    iterations: Count = 30
    """Buffers of each training."""
    contexts: Count = 16
    """First frames of a buffer, 16 clips of each."""

    def trials(self) -> list[SamplerTrial[OutcomePlan]]:
        plan = OutcomePlan(
            self.iterations, contexts=self.contexts, group_size=PAPER_GROUP, eval_contexts=self.eval_contexts,
            eval_every=5, rewards=((EXECUTION, 1.0),),
        )
        return [SamplerTrial(arm, plan) for arm in self.with_rate(paper_samplers())]

    def heldout_config(self, seed: int) -> VideoRlConfig:
        trial = self.trials()[0]
        return config_of(trial.sampler, trial.plan, seed, "outcome", dict(trial.plan.rewards))


def paid_trials(sampler: SamplerSetup, plan: OutcomePlan) -> list[SamplerTrial[OutcomePlan]]:
    """The same sampler, paid by the embedded judge alone, by the action world model alone, and by that and the outcome.
    """
    rewards: dict[str, tuple[tuple[str, float], ...]] = {
        f"judge {plan.rubric}": ((AGENT, 1.0),), EXECUTION: ((EXECUTION, 1.0),),
        f"{EXECUTION} and outcome": ((EXECUTION, 1.0), ("outcome", 0.3)),
    }
    return [
        SamplerTrial(replace(sampler, name=f"{sampler.name}, {name}"), replace(plan, rewards=weights))
        for name, weights in rewards.items()
    ]


def weights_name(sampler: str, seed: int, buffers: int) -> str:
    """The file of weights that were trained on so many buffers."""
    return f"{training_name(sampler, seed)}_{buffers}.safetensors"


def kept_weights(folder: Path, row: Mapping[str, Any], buffers: int) -> Path:
    """The file of a row's weights after so many buffers. Raises ValueError: none is kept, or it is of another training.
    """
    path = folder / weights_name(row["sampler"], row["seed"], buffers)
    if not path.is_file() or file_sha256(path) != row["weights"].get(str(buffers)):
        raise ValueError(f"{path} is not what the training of this row left; take another --json file to train again")
    return path


@cache
def _yardstick(video_model: Path, heldout_bags: tuple[Path, ...], device: torch.device) -> tuple[Clips, Yardstick]:
    """The first MEASURED held-out recordings, and what clips are measured with, of all of them."""
    folder, probe = load_video_folder(video_model, device), load_probe(shipped_model(TASK), device)
    recordings, reader = load_clips(heldout_bags, folder.clip["stride"]), load_success_reader(video_model, TASK)
    by = make_yardstick(folder.codec, recordings, probe, reader, load_config("cpu", {"task": TASK}).simulation)
    return recordings.first(MEASURED), by


def _accepted(frames: Tensor, heldout: Clips, config: VideoRlConfig, given: int, fps: float) -> FloatArray:
    """1 where the judge takes a decoded clip for a success, (N,)."""
    jobs = buffer_jobs(frames, heldout, "0" * 64, config, given=given, fps=fps)
    with closing(open_judge(config, heldout, fps)) as judge:
        return np.array([accepts(verdict) is True for verdict in judge.judge(jobs)], np.float32)
