"""Diversity: how far the videos of one context spread, at which cost in quality. DD-19.

Shapes: n videos of a context, F frames, C channels, H W cells or pixels.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.experiment import Count, OnDevice, console
from benchmarks.video_rl import tables
from benchmarks.video_rl.discs import base_of
from benchmarks.video_rl.samplers import SamplerSetup, diversity_samplers
from benchmarks.video_rl.sources import TASK, recorded_episodes, sample_scenes
from benchmarks.video_rl.spread import centred_pixels, rollout_diversity
from benchmarks.video_rl.trainings import select, settings_of
from wm_nodes.config.load import load_video_config
from wm_nodes.config.seed_ranges import HELDOUT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.video_model import VideoNetwork
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.reference_reward import SEEN_MOTION, load_probe
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts
from wm_nodes.video_rl.toy_scene import draw_scenes, load_base, opacity_at
from wm_nodes.world_model import Tokenizer, load_model_folder
from wm_nodes.world_model.positions import columns_of

FEATURES = "centred pixels (each frame less its mean), no learned backbone"
REACH = 5.0
"""Cells that a disc can come to in the time of a video."""
QUALITY_BACKGROUND, QUALITY_MASS = 0.10, 0.02
"""Equal quality: background error within 10 % of the other sampler's, mass within 0.02."""
MARGIN_PX = 4
"""The moving part of a picture reaches this far beyond the pixels that change in the recording."""
BATCH = 64
"""Pictures per call of a tokenizer."""
SPREADS = ("diversity", "diversity_dynamic", "object_spread_cm", "reward_std")
SCORES = ("tracking", "scenery", "object_cm")


@dataclass(kw_only=True)
class Diversity(OnDevice):
    """Diversity of groups of videos, of several samplers."""

    samplers: tuple[str, ...] = ()
    """Names of those to measure; without, all."""
    contexts: Count = 100
    """Groups."""
    group_size: Count = 8
    """Videos of each context."""
    seed: int = 0
    """Of every random number."""

    def chosen(self) -> list[SamplerSetup]:
        return select({sampler.name: sampler for sampler in diversity_samplers()}, self.samplers)

    def with_both_noises(self) -> list[SamplerSetup]:
        """Each sampler with initial noise of every video's own, then each with one that a group shares."""
        return [replace(setup, shared_noise=shared) for shared in (False, True) for setup in self.chosen()]


@dataclass(kw_only=True)
class DiscDiversity(Diversity):
    """Diversity on the moving disc, at equal quality and noise budget. DD-19."""

    base_model: Path | None = None
    """Weights of another base model than the shipped one."""

    def run(self) -> None:
        model = load_base(self.base_model, self.where)
        plan = {"contexts": self.contexts, "group_size": self.group_size}
        rows = [
            measure_discs(model, setup, **plan, seed=self.seed)
            for setup in tqdm(self.with_both_noises(), desc="diversity", unit="sampler")
        ]
        facts = {"plan": plan, "seed": self.seed, "features": FEATURES, **settings_of(self.chosen())}
        comparisons = disc_comparisons(rows, self.seed)
        self.write({**facts, **base_of(self.base_model), "rows": rows, "comparisons": comparisons})
        console.print(tables.diversity_table(rows, self.seed))


@dataclass(kw_only=True)
class ClipDiversity(Diversity):
    """Diversity on a video model of recorded episodes; features are those of the world model's frozen tokenizer."""

    context_bags: tuple[Path, ...] = ()
    """Episodes to take contexts from; without, new ones of seeds that no model has seen."""
    video_model: Path = shipped_model(TASK) / "video_model"
    """Folder to sample from."""
    preset: str = "recommended"
    """Of the settings of loop 2: a name, or a .yaml."""

    def run(self) -> None:
        config = load_video_config(self.preset, {"seed": self.seed})
        folder, probe = load_video_folder(self.video_model, self.where), load_probe(shipped_model(TASK), self.where)
        bags = self.context_bags or recorded_episodes(self.contexts, HELDOUT)
        clips = load_clips(bags, folder.clip["stride"])
        drawn = numpy_stream(self.seed, "clip_diversity").permutation(len(clips))[: self.contexts]
        contexts = clips.select(torch.from_numpy(drawn))
        tokenizer = load_model_folder(shipped_model(TASK), self.where).tokenizer
        setups, rows = self.with_both_noises(), list[dict[str, Any]]()
        source = RecordedContexts(folder, contexts, config, probe)
        with tqdm(total=len(setups) * len(contexts), desc="clips", unit="context") as bar:
            for setup in setups:
                bar.set_postfix_str(setup.name)
                rows.append(measure_clips(source, setup, tokenizer, self.group_size, bar.update))
        compared = clip_comparisons(rows, self.seed)
        facts = {
            "contexts": len(contexts), "group_size": self.group_size, "seed": self.seed, "rewards": config.rewards,
            "features": f"frozen tokenizer of {shipped_model(TASK).name}", "sha256": folder.manifest["sha256"],
        }
        self.write({**facts, **settings_of(self.chosen()), "rows": rows, "comparisons": compared})
        console.print(tables.clip_table(rows, self.seed), tables.clip_comparison_table(compared))


def measure_discs(
    model: VideoNetwork, sampler: SamplerSetup, contexts: int, group_size: int, seed: int
) -> dict[str, Any]:
    """Per context: diversity, diversity of the dynamic region, within-group reward std; means of the true metrics."""
    scenes = draw_scenes(contexts, seed, "diversity")
    buffer = sample_scenes(model, sampler, scenes, group_size, seed)
    groups = buffer.rollout.latents.view(contexts, group_size, *buffer.rollout.latents.shape[1:])
    reach = opacity_at(scenes.path(scenes.action)[:, :1].expand(-1, groups.shape[3], -1), REACH)
    moving = (reach > 0.3).float()[:, None].to(groups.device)
    scores = {name: values.view(contexts, group_size) for name, values in buffer.rewards.items()}
    return {
        **_named(sampler),
        "diversity": [rollout_diversity(centred_pixels(videos)) for videos in groups],
        "diversity_dynamic": [
            rollout_diversity(centred_pixels(videos * where)) for videos, where in zip(groups, moving, strict=True)
        ],
        "reward_std": scores["reward"].std(1, correction=0).tolist(),
        **{name: scores[name].mean(1).tolist() for name in ("reward", "background", "mass", "obeyed")},
        "noise_share": buffer.rollout.spent_noise,
    }


def measure_clips(
    source: RecordedContexts, sampler: SamplerSetup, tokenizer: Tokenizer, group_size: int,
    on_context: Callable[[], Any] = lambda: None,
) -> dict[str, Any]:
    """Sample a group of each context with the sampler; lists of one value per context.

    diversity, diversity_dynamic: DD-19 of whole pictures, and of what moves in the recording. object_spread_cm: rms
    distance of the last frames' object positions from their mean. reward, reward_std: of source.config.rewards.
    """
    rollout = sampler.rollout.with_values(micro_batch=source.config.rollout.micro_batch)
    groups = source.config.groups.with_values(shared_noise=sampler.shared_noise)
    config = source.config.with_values(rollout=rollout, groups=groups)
    source = RecordedContexts(source.folder, source.contexts, config, source.probe)
    found: dict[str, list[float]] = {}
    for index in range(len(source.contexts)):
        request = GroupRequest((index,), group_size, index, 0)
        buffer = source.score(request, source.sample(request))
        frames, K = source.folder.codec.decode(buffer.rollout.latents), buffer.condition.num_conditioning
        last = source.probe.read(frames[:, -1:])[:, 0][..., columns_of(source.contexts.task, "object")]
        moving = moving_part(source.contexts.frames[index]).to(frames.device)
        values = {
            "diversity": group_diversity(frames[:, K:], tokenizer),
            "diversity_dynamic": group_diversity(frames[:, K:] * moving, tokenizer),
            "object_spread_cm": 100 * float(np.sqrt(((last - last.mean(0)) ** 2).sum(-1).mean())),
            "reward": float(buffer.rewards["total"].mean()),
            "reward_std": float(buffer.rewards["total"].std(correction=0)),
            "noise_share": buffer.rollout.spent_noise,
        }
        values |= {name: float(buffer.rewards[name].mean()) for name in SCORES}
        for name, value in values.items():
            found.setdefault(name, []).append(value)
        on_context()
    return {**_named(sampler), **found}


def group_diversity(frames: Tensor, tokenizer: Tokenizer) -> float:
    """DD-19 of uint8 videos (n, F, H, W, 3)."""
    features = frame_features(frames.flatten(0, 1), tokenizer)
    return rollout_diversity(features.view(*frames.shape[:2], -1))


@torch.no_grad()
def frame_features(frames: Tensor, tokenizer: Tokenizer) -> Tensor:
    """Encoder output of uint8 pictures (N, H, W, 3) less its mean over the picture, (N, D)."""
    parts = torch.split(frames, BATCH)  # type: ignore[no-untyped-call]
    tokens = torch.cat([tokenizer.features(tokenizer.to_pixels(part)) for part in parts])
    return (tokens - tokens.mean(1, keepdim=True)).flatten(1)


def moving_part(frames: Tensor) -> Tensor:
    """1 where a recorded clip (F, H, W, 3) ever differs from its first frame, and MARGIN_PX around; uint8 (H, W, 1)."""
    changed = (frames.int() - frames[:1].int()).abs().amax((0, 3)) > SEEN_MOTION
    grown = F.max_pool2d(changed.float()[None, None], 2 * MARGIN_PX + 1, stride=1, padding=MARGIN_PX)
    return grown[0, 0, :, :, None].to(torch.uint8)


def disc_comparisons(rows: Sequence[Mapping[str, Any]], seed: int) -> list[dict[str, Any]]:
    """The paired difference in diversity, and whether quality is equal, see QUALITY_BACKGROUND."""
    found = []
    for row, base in _pairs(rows):
        mean, low, high = bootstrap_mean(np.subtract(row["diversity"], base["diversity"]), seed=seed)
        background = float(np.mean(row["background"]) / np.mean(base["background"]) - 1)
        mass = float(np.mean(row["mass"]) - np.mean(base["mass"]))
        equal = abs(background) <= QUALITY_BACKGROUND and abs(mass) <= QUALITY_MASS
        found.append({
            **_names(row, base), "difference": mean, "low": low, "high": high, "background_change": background,
            "mass_change": mass, "equal_quality": equal, "more_diverse": equal and low > 0,
        })
    return found


def clip_comparisons(rows: Sequence[Mapping[str, Any]], seed: int) -> list[dict[str, Any]]:
    """Paired differences over contexts: mean, 95 % bootstrap interval."""
    return [
        {**_names(row, base), **{
            name: bootstrap_mean(np.subtract(row[name], base[name]), seed=seed) for name in (*SPREADS, "tracking")
        }}
        for row, base in _pairs(rows)
    ]


def _pairs(rows: Sequence[Mapping[str, Any]]) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Each DynDiff sampler with each CPS sampler of one regime of initial noise."""
    return [
        (row, base) for row, base in product(rows, rows)
        if row["sampler"].startswith("DynDiff") and base["sampler"].startswith("CPS")
        and row["shared_noise"] == base["shared_noise"]
    ]


def _names(row: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    noise = [float(np.mean(one["noise_share"])) for one in (row, base)]
    return {
        "sampler": row["sampler"], "base": base["sampler"], "shared_noise": row["shared_noise"], "noise_share": noise,
    }


def _named(sampler: SamplerSetup) -> dict[str, Any]:
    return {"sampler": sampler.name, "shared_noise": sampler.shared_noise}
