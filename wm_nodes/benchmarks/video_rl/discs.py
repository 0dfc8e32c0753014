"""Trainings on the moving disc: every sampler on one learner, the paper's ablations, a reward that can be hacked."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from benchmarks.experiment import Count, OnDevice, console
from benchmarks.video_rl import tables
from benchmarks.video_rl.comparison import SamplerComparison
from benchmarks.video_rl.learning import train_on_discs
from benchmarks.video_rl.samplers import LEARNER, DiscPlan, learning_samplers
from benchmarks.video_rl.trainings import OnIteration, Trainings
from benchmarks.video_rl.trials import SamplerTrial, ablation_trials, hacking_trials
from wm_nodes.config.load import load_video_config
from wm_nodes.core.files import file_sha256, write_atomic
from wm_nodes.core.seeding import torch_stream
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model import Condition, VideoNetwork
from wm_nodes.video_model.flow_matching import train_video_model
from wm_nodes.video_rl.toy_scene import BASE, NETWORK, NUM_ACTIONS, draw_scenes, load_base

BASE_BATCH = 16
OBEDIENCE = 0.4
"""Share of the training videos in which the disc obeys its action for certain; in the others its way is drawn."""


def base_of(path: Path | None) -> dict[str, Any]:
    """Which base model was measured; None: the shipped one."""
    return {"sha256": {"base": file_sha256(path or BASE)}}


def training_batch(count: int, seed: int, iteration: int) -> tuple[Tensor, Condition]:
    """Videos (B, C, F, H, W) in which the action is obeyed with probability OBEDIENCE, and their condition."""
    scenes = draw_scenes(count, seed, "training", iteration)
    generator = torch_stream(seed, "moving_disc_obedience", iteration)
    obeys = torch.rand(count, generator=generator) < OBEDIENCE
    direction = torch.where(obeys, scenes.action, torch.randint(NUM_ACTIONS, (count,), generator=generator))
    return scenes.videos(direction), scenes.condition()


@dataclass(kw_only=True)
class DiscBase(OnDevice):
    """Train the video model of the moving disc that every experiment on it begins with (minutes on one core)."""

    iterations: Count = 4000
    """Of flow matching."""
    out: Path = Path("runs/moving_disc")
    """Folder of the checkpoint and the weights."""
    seed: int = 0
    """Of every random number."""

    def run(self) -> None:
        torch.manual_seed(self.seed)
        model = VideoNetwork(NETWORK).to(self.where)
        train_video_model(
            model, lambda iteration: training_batch(BASE_BATCH, self.seed, iteration),
            load_video_config("base").model.training.with_values(num_iterations=self.iterations),
            seed=self.seed, run_dir=self.out,
        )
        command = f"wm benchmark disc-base --seed {self.seed} --iterations {self.iterations}"
        path = self.out / "video_model.safetensors"
        write_atomic(path, pack_weights(model, {"command": command}).data)
        console.print(f"written {path}", highlight=False)


@dataclass(kw_only=True)
class DiscTrainings(Trainings[DiscPlan]):
    """Trainings on the moving disc."""

    iterations: Count
    """Buffers of each training."""
    scenes: Count = 6
    """Contexts per iteration, 8 videos each."""
    eval_scenes: Count = 100
    """Held-out scenes per evaluation."""
    base_model: Path | None = None
    """Weights of another base model than the shipped one."""

    eval_every: ClassVar[int] = 5
    """Buffers between two evaluations."""

    def plan(self) -> DiscPlan:
        return DiscPlan(
            self.iterations, self.scenes, eval_contexts=self.eval_scenes, eval_every=self.eval_every
        )

    def base(self) -> dict[str, Any]:
        return base_of(self.base_model)

    def train(self, trial: SamplerTrial[DiscPlan], seed: int, on_iteration: OnIteration) -> dict[str, Any]:
        return train_on_discs(load_base(self.base_model, self.where), trial.sampler, trial.plan, seed, on_iteration)


@dataclass(kw_only=True)
class Learning(DiscTrainings):
    """Reward against model calls on the moving disc, every sampler on one learner."""

    iterations: Count = 40
    """Buffers of each training."""

    def trials(self) -> list[SamplerTrial[DiscPlan]]:
        return [SamplerTrial(sampler, self.plan()) for sampler in learning_samplers(LEARNER)]


@dataclass(kw_only=True)
class Ablations(DiscTrainings):
    """KL, advantage clip, guidance and resolution on the moving disc, in pairs of equal model calls."""

    iterations: Count = 12
    """Buffers of each training."""

    eval_every: ClassVar[int] = 4

    def trials(self) -> list[SamplerTrial[DiscPlan]]:
        return ablation_trials(LEARNER, self.plan())[0]

    def pairs(self, rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
        return ablation_trials(LEARNER, self.plan())[1]


@dataclass(kw_only=True)
class Hacking(DiscTrainings):
    """A reward that can be hacked, and what detects it."""

    iterations: Count = 25
    """Buffers of each training."""

    eval_every: ClassVar[int] = 3

    def trials(self) -> list[SamplerTrial[DiscPlan]]:
        return hacking_trials(LEARNER, self.plan())

    def pairs(self, rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
        return []

    def show(self, rows: list[dict[str, Any]], comparisons: list[SamplerComparison]) -> None:
        console.print(tables.hacking_table(rows))
