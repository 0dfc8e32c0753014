"""Diversity on clips of recorded contexts: how far the videos of one context spread, and at which cost in quality.

Shapes: n videos of a context, F frames, H W 3 image. DD-19.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.video_rl.samplers import SamplerSetup
from wm_nodes.config.video import RolloutConfig, VideoRlConfig
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.diversity import rollout_diversity
from wm_nodes.video_rl.frame_features import FrameFeatures
from wm_nodes.video_rl.reference_reward import SEEN_MOTION, mixed, score_clips
from wm_nodes.video_rl.sampling import ClipGenerator, GroupRequest
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.validation.open_loop import OBJECT

MARGIN_PX = 4
"""The moving part of a picture reaches this far beyond the pixels that change in the recording."""
SPREADS = ("diversity", "diversity_dynamic", "object_spread_cm", "reward_std")
SCORES = ("tracking", "scenery", "object_cm", "motion")


def measure_clips(
    folder: VideoFolder, contexts: Clips, arm: SamplerSetup, features: FrameFeatures, probe: PositionProbe,
    config: VideoRlConfig, group_size: int, on_context: Callable[[], Any] = lambda: None,
) -> dict[str, Any]:
    """Sample a group of each context with the arm; lists of one value per context.

    diversity, diversity_dynamic: DD-19 of whole pictures, and of what moves in the recording. object_spread_cm: rms
    distance of the last frames' object positions from their mean. reward, reward_std: of config.rewards.
    """
    rollout = replace(arm.rollout, micro_batch=config.rollout.micro_batch)
    sampled_so = config.with_values(rollout=RolloutConfig.model_validate(rollout, from_attributes=True))
    generator = ClipGenerator(folder, contexts, sampled_so)
    found: dict[str, list[float]] = {}
    for index in range(len(contexts)):
        request = GroupRequest((index,), group_size, index, 0, arm.shared_noise)
        buffer = generator.sample(request)
        frames = folder.codec.decode(buffer.rollout.latents)
        K = buffer.condition.num_conditioning
        scores = score_clips(frames, generator.references(request), probe, K).named()
        rewards, where = mixed(scores, config.rewards), moving_part(contexts.frames[index])
        last = probe.read(frames[:, -1:])[:, 0][..., OBJECT]
        values = {
            "diversity": group_diversity(frames[:, K:], features),
            "diversity_dynamic": group_diversity(frames[:, K:] * where, features),
            "object_spread_cm": 100 * float(np.sqrt(((last - last.mean(0)) ** 2).sum(-1).mean())),
            "reward": float(rewards.mean()), "reward_std": float(rewards.std(correction=0)),
            "noise_share": buffer.rollout.spent_noise,
        }
        values |= {name: float(scores[name].mean()) for name in SCORES}
        for name, value in values.items():
            found.setdefault(name, []).append(value)
        on_context()
    return {"arm": arm.name, "shared_noise": arm.shared_noise, "features": features.name, **found}


def group_diversity(frames: Tensor, features: FrameFeatures) -> float:
    """DD-19 of uint8 videos (n, F, H, W, 3)."""
    return rollout_diversity(features(frames.flatten(0, 1)).view(*frames.shape[:2], -1))


def moving_part(frames: Tensor) -> Tensor:
    """1 where a recorded clip (F, H, W, 3) ever differs from its first frame, and MARGIN_PX around; uint8 (H, W, 1)."""
    changed = (frames.int() - frames[:1].int()).abs().amax((0, 3)) > SEEN_MOTION
    grown = F.max_pool2d(changed.float()[None, None], 2 * MARGIN_PX + 1, stride=1, padding=MARGIN_PX)
    return grown[0, 0, :, :, None].to(torch.uint8)


def clip_comparisons(rows: Sequence[Mapping[str, Any]], seed: int) -> list[dict[str, Any]]:
    """Each DynDiff arm less each CPS arm of one regime, paired over contexts: mean, 95 % bootstrap interval."""
    found = []
    for row, base in product(rows, rows):
        pair = row["arm"].startswith("DynDiff") and base["arm"].startswith("CPS")
        if not pair or row["shared_noise"] != base["shared_noise"]:
            continue
        differences = {
            name: bootstrap_mean(np.subtract(row[name], base[name]), seed=seed) for name in (*SPREADS, "tracking")
        }
        noise = [float(np.mean(one["noise_share"])) for one in (row, base)]
        names = {"arm": row["arm"], "base": base["arm"], "shared_noise": row["shared_noise"], "noise_share": noise}
        found.append({**names, **differences})
    return found
