"""Diversity: how far the videos of one context spread, at which cost in quality. DD-19.

Shapes: n videos of a context, F frames, C channels, H W cells or pixels.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.video_rl.samplers import SamplerSetup
from benchmarks.video_rl.sources import sample_scenes
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.video_model import VideoNetwork
from wm_nodes.video_rl import frame_features
from wm_nodes.video_rl.diversity import rollout_diversity
from wm_nodes.video_rl.frame_features import FrameFeatures
from wm_nodes.video_rl.reference_reward import SEEN_MOTION
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts
from wm_nodes.video_rl.toy_scene import centred_pixels, draw_scenes, opacity_at
from wm_nodes.world_model import load_model_folder
from wm_nodes.world_model.validation.open_loop import OBJECT

FEATURES = "centred pixels (each frame less its mean), no learned backbone"
REACH = 5.0
"""Cells that a disc can come to in the time of a video."""
QUALITY_BACKGROUND, QUALITY_MASS = 0.10, 0.02
"""Equal quality: background error within 10 % of the other sampler's, mass within 0.02."""
MARGIN_PX = 4
"""The moving part of a picture reaches this far beyond the pixels that change in the recording."""
SPREADS = ("diversity", "diversity_dynamic", "object_spread_cm", "reward_std")
SCORES = ("tracking", "scenery", "object_cm", "motion")


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
    source: RecordedContexts, sampler: SamplerSetup, features: FrameFeatures, group_size: int,
    on_context: Callable[[], Any] = lambda: None,
) -> dict[str, Any]:
    """Sample a group of each context with the sampler; lists of one value per context.

    diversity, diversity_dynamic: DD-19 of whole pictures, and of what moves in the recording. object_spread_cm: rms
    distance of the last frames' object positions from their mean. reward, reward_std: of source.config.rewards.
    """
    rollout = sampler.rollout.with_values(micro_batch=source.config.rollout.micro_batch)
    config = source.config.with_values(rollout=rollout)
    source = RecordedContexts(source.folder, source.contexts, config, source.probe)
    found: dict[str, list[float]] = {}
    for index in range(len(source.contexts)):
        request = GroupRequest((index,), group_size, index, 0, sampler.shared_noise)
        buffer = source.score(request, source.sample(request))
        frames, K = source.folder.codec.decode(buffer.rollout.latents), buffer.condition.num_conditioning
        last = source.probe.read(frames[:, -1:])[:, 0][..., OBJECT]
        moving = moving_part(source.contexts.frames[index]).to(frames.device)
        values = {
            "diversity": group_diversity(frames[:, K:], features),
            "diversity_dynamic": group_diversity(frames[:, K:] * moving, features),
            "object_spread_cm": 100 * float(np.sqrt(((last - last.mean(0)) ** 2).sum(-1).mean())),
            "reward": float(buffer.rewards["total"].mean()),
            "reward_std": float(buffer.rewards["total"].std(correction=0)),
            "noise_share": buffer.rollout.spent_noise,
        }
        values |= {name: float(buffer.rewards[name].mean()) for name in SCORES}
        for name, value in values.items():
            found.setdefault(name, []).append(value)
        on_context()
    return {**_named(sampler), "features": features.name, **found}


def load_features(name: str, task: str, device: torch.device) -> FrameFeatures:
    """Frame features by name, on `device`: pixels, random, tokenizer (of the task's shipped world model), or the folder
    of a backbone."""
    if name == "pixels":
        return frame_features.CentredPixels()
    if name == "random":
        return frame_features.RandomFeatures()
    if name == "tokenizer":
        folder = shipped_model(task)
        return frame_features.TokenizerFeatures(load_model_folder(folder, device).tokenizer, folder.name)
    return frame_features.load_backbone(Path(name), device)


def group_diversity(frames: Tensor, features: FrameFeatures) -> float:
    """DD-19 of uint8 videos (n, F, H, W, 3)."""
    return rollout_diversity(features(frames.flatten(0, 1)).view(*frames.shape[:2], -1))


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
