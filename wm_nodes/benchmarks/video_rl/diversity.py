"""Diversity: how far the videos of one context spread, at which cost in quality. DD-19.

Shapes: N videos in groups of one scene, F frames, C channels, H W cells.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from benchmarks.video_rl.learning import sample_groups
from benchmarks.video_rl.samplers import SamplerSetup
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.video_model import VideoNetwork
from wm_nodes.video_rl.diversity import rollout_diversity
from wm_nodes.video_rl.toy_scene import centred_pixels, draw_scenes, opacity_at

FEATURES = "centred pixels (each frame less its mean), no learned backbone"
REACH = 5.0
"""Cells that a disc can come to in the time of a video."""
QUALITY_BACKGROUND, QUALITY_MASS = 0.10, 0.02
"""Equal quality: background error within 10 % of the other arm's, mass within 0.02."""


@dataclass(frozen=True)
class DiversityPlan:
    """contexts x group_size videos per arm and regime."""

    contexts: int = 100
    group_size: int = 8


def measure_sampler(model: VideoNetwork, arm: SamplerSetup, plan: DiversityPlan, seed: int) -> dict[str, Any]:
    """Per context: diversity, diversity of the dynamic region, within-group reward std; means of the true metrics."""
    scenes = draw_scenes(plan.contexts, seed, "diversity")
    buffer, scores = sample_groups(model, arm, scenes, plan.group_size, seed, 0, 0)
    groups = buffer.rollout.latents.view(plan.contexts, plan.group_size, *buffer.rollout.latents.shape[1:])
    moving = _moving(scenes.path(scenes.action)[:, :1].expand(-1, groups.shape[3], -1))
    rewards = scores.reward.view(plan.contexts, plan.group_size)
    return {
        "arm": arm.name,
        "shared_noise": arm.shared_noise,
        "diversity": [rollout_diversity(centred_pixels(videos)) for videos in groups],
        "diversity_dynamic": [
            rollout_diversity(centred_pixels(videos * where)) for videos, where in zip(groups, moving, strict=True)
        ],
        "reward_std": rewards.std(1, correction=0).tolist(),
        "reward": rewards.mean(1).tolist(),
        "background": scores.background.view(plan.contexts, -1).mean(1).tolist(),
        "mass": scores.mass.view(plan.contexts, -1).mean(1).tolist(),
        "obeyed": scores.obeyed.view(plan.contexts, -1).mean(1).tolist(),
        "noise_share": buffer.rollout.spent_noise,
    }


def compare(arm: dict[str, Any], base: dict[str, Any], seed: int) -> dict[str, Any]:
    """The paired difference in diversity, arm - base, and whether quality is equal: the pass rule of 5.2."""
    difference = np.subtract(arm["diversity"], base["diversity"])
    mean, low, high = bootstrap_mean(difference, seed=seed)
    background = float(np.mean(arm["background"]) / np.mean(base["background"]) - 1)
    mass = float(np.mean(arm["mass"]) - np.mean(base["mass"]))
    equal = abs(background) <= QUALITY_BACKGROUND and abs(mass) <= QUALITY_MASS
    return {
        "arm": arm["arm"], "base": base["arm"], "shared_noise": arm["shared_noise"], "difference": mean, "low": low,
        "high": high, "background_change": background, "mass_change": mass, "equal_quality": equal,
        "noise_share": (arm["noise_share"], base["noise_share"]), "more_diverse": equal and low > 0,
    }


def _moving(start: Tensor) -> Tensor:
    """1 where a disc that begins at `start` (B, F, 2) can come to in the time, (B, 1, F, H, W)."""
    reach = opacity_at(start, REACH)
    return (reach > 0.3).float()[:, None]
