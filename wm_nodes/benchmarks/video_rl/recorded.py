"""On a video model of recorded episodes: what samplers learn, and train low, infer higher: pictures of other sizes.

Shapes: E contexts, F frames, H W 3 image.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from benchmarks.experiment import Count, OnDevice, console
from benchmarks.video_rl import tables
from benchmarks.video_rl.comparison import CLIP_MEASURES, SamplerComparison
from benchmarks.video_rl.learning import train_sampler
from benchmarks.video_rl.samplers import LearningPlan, clip_learning_samplers
from benchmarks.video_rl.sources import TASK, RecordedSource, config_of, recorded_episodes
from benchmarks.video_rl.trainings import OnIteration, Trainings, recordings_of
from benchmarks.video_rl.trials import SamplerTrial
from wm_nodes.config.load import load_video_config
from wm_nodes.config.seed_ranges import HELDOUT, NEW_CONTEXTS
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.progress import tqdm
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_rl.reference_reward import load_probe, score_clips
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.world_model.position_probe import PositionProbe

MODEL, CODEC, ENLARGED, COPY = "model", "codec alone", "the model's own size, enlarged", "first frame repeated"


@dataclass(kw_only=True)
class ClipLearning(Trainings[LearningPlan]):
    """Learning on a video model of recorded episodes."""

    iterations: Count = LearningPlan.iterations
    """Buffers of each training."""
    contexts: Count = 400
    """New episodes to train on, where none are given."""
    eval_contexts: Count = LearningPlan.eval_contexts
    """Held-out contexts."""
    context_bags: tuple[Path, ...] = ()
    """Episodes to take contexts from; without, new ones of seeds that no model has seen."""
    heldout_bags: tuple[Path, ...] = ()
    """And held-out ones."""
    video_model: Path = shipped_model(TASK) / "video_model"
    """Folder that training begins with."""

    measures: ClassVar = CLIP_MEASURES

    def trials(self) -> list[SamplerTrial[LearningPlan]]:
        plan = LearningPlan(self.iterations, eval_contexts=self.eval_contexts)
        return [SamplerTrial(sampler, plan) for sampler in clip_learning_samplers()]

    def base(self) -> dict[str, Any]:
        recordings = {"new": 0 if self.context_bags else self.contexts,
                      **recordings_of(self.context_bags, self.heldout_bags)}
        return {"sha256": load_video_folder(self.video_model).manifest["sha256"], "recordings": recordings}

    def train(self, trial: SamplerTrial[LearningPlan], seed: int, on_iteration: OnIteration) -> dict[str, Any]:
        folder, probe = load_video_folder(self.video_model, self.where), load_probe(shipped_model(TASK), self.where)
        contexts, heldout = (
            load_clips(bags or recorded_episodes(count, seeds), folder.clip["stride"])
            for bags, count, seeds in (
                (self.context_bags, self.contexts, NEW_CONTEXTS), (self.heldout_bags, self.eval_contexts, HELDOUT)
            )
        )
        config = config_of(trial.sampler, trial.plan, seed)
        source = RecordedSource(folder, contexts, heldout, probe, config)
        return train_sampler(source, trial.sampler, trial.plan, seed, on_iteration)

    def show(self, rows: list[dict[str, Any]], comparisons: list[SamplerComparison]) -> None:
        console.print(tables.clip_training_table(rows), tables.comparison_table(comparisons))


@dataclass(kw_only=True)
class Resolution(OnDevice):
    """A video model on larger pictures than it was trained on."""

    sizes: tuple[Count, ...] = (80, 96, 128)
    """Sides of a picture, px."""
    contexts: Count = 100
    """Episodes of each size."""
    context_bags: tuple[Path, ...] = ()
    """The same episodes in several sizes, a bag of each, the model's own size first; without, new ones."""
    video_model: Path = shipped_model(TASK) / "video_model"
    """Folder to sample from."""
    preset: str = "recommended"
    """Of the settings of loop 2: a name, or a .yaml."""
    seed: int = 0
    """Of the noise."""

    def run(self) -> None:
        config = load_video_config(self.preset, {"seed": self.seed})
        folder, probe = load_video_folder(self.video_model, self.where), load_probe(shipped_model(TASK), self.where)
        recordings = [[bag] for bag in self.context_bags] or [
            recorded_episodes(self.contexts, HELDOUT, changes={"simulation.image_size": side})
            for side in (probe.height, *self.sizes)
        ]
        rows, own = list[dict[str, Any]](), None
        for bags in tqdm(recordings, desc="resolution", unit="size"):
            clips = load_clips(bags, folder.clip["stride"])
            clips = clips.first(self.contexts)
            if own is None:
                own = sample_by_ode(folder, clips, config, config.evaluation.num_steps)
            rows += size_rows(folder, clips, own, config, probe)
        self.write({"seed": self.seed, "sha256": folder.manifest["sha256"], "rows": rows})
        console.print(tables.resolution_table(rows))


def size_rows(
    folder: VideoFolder, contexts: Clips, own: Tensor, config: VideoRlConfig, probe: PositionProbe
) -> list[dict[str, Any]]:
    """Scores of each context, by what is shown. own: clips of the same contexts at the model's own size."""
    frames = contexts.frames
    shown = {
        MODEL: sample_by_ode(folder, contexts, config, config.evaluation.num_steps),
        ENLARGED: resized(own, *frames.shape[2:4]),
        CODEC: folder.codec.decode(folder.codec.encode(frames)),
        COPY: frames[:, :1].expand_as(frames),
    }
    return [
        {"side_px": frames.shape[2], "shown": name, **{measure: values.tolist() for measure, values in scores.items()}}
        for name, clips in shown.items()
        for scores in [score_clips(clips, contexts, probe, folder.clip["num_conditioning"])]
    ]


def resized(frames: Tensor, height: int, width: int) -> Tensor:
    """uint8 (E, F, H, W, 3) as (E, F, height, width, 3), bilinear."""
    flat = frames.flatten(0, 1).permute(0, 3, 1, 2).float()
    made = interpolate(flat, (height, width), mode="bilinear", antialias=True).round().to(torch.uint8)
    return made.permute(0, 2, 3, 1).reshape(*frames.shape[:2], height, width, 3)
