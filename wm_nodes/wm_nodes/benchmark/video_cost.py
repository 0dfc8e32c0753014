"""Claim C: what each KL anchor costs in seconds and bytes, side by side on the same buffers. Sections 1.6, 5.4."""

import time
from dataclasses import replace
from statistics import median
from typing import Any

from wm_nodes.benchmark.moving_disc import draw_scenes
from wm_nodes.benchmark.video_arms import dyndiff, sampler_arm
from wm_nodes.benchmark.video_learning import sample_groups
from wm_nodes.learning.grpo_settings import Anchor, GrpoSettings
from wm_nodes.learning.video_grpo import GrpoLearner
from wm_nodes.video_model import SamplerSettings, VideoNetwork
from wm_nodes.video_model.mask import dynamic_mask

ANCHORS: tuple[Anchor, ...] = ("buffer", "frozen", "dual")
PARTS = ("forward", "kl", "backward")
SCENES, GROUP = 4, 8


def measure_anchors(model: VideoNetwork, learner: GrpoSettings, repeats: int, seed: int) -> list[dict[str, Any]]:
    """One row per anchor: median seconds of each part of training on one buffer, turn by turn, and the bytes kept."""
    arm = sampler_arm("DynDiff", dyndiff(0.4, "sparse", "rms"), learner)
    buffer, scores = sample_groups(model, arm, draw_scenes(SCENES, seed, "cost"), GROUP, seed, 0, 0)
    buffer = buffer.with_rewards({"total": scores.reward})
    times: dict[str, dict[str, list[float]]] = {anchor: {part: [] for part in PARTS} for anchor in ANCHORS}
    for _ in range(repeats):
        for anchor in ANCHORS:
            kl = replace(learner.kl, anchor=anchor, dual_every=1)
            grpo = GrpoLearner(model, replace(learner, kl=kl, learning_rate=0.0), arm.rollout, seed=seed)
            updates = grpo.train(buffer).updates
            for part in PARTS:
                times[anchor][part].append(sum(getattr(update, f"{part}_seconds") for update in updates))
    weights = sum(p.nbytes for p in model.parameters())
    zeta = 0 if buffer.rollout.zeta is None else buffer.rollout.zeta.nbytes
    kept = {"buffer": zeta + buffer.rollout.mask.nbytes, "frozen": weights}
    kept["dual"] = kept["buffer"] + weights
    return [
        {"anchor": anchor, **{f"{part}_s": median(times[anchor][part]) for part in PARTS}, "bytes": kept[anchor]}
        for anchor in ANCHORS
    ]


def measure_rollout(model: VideoNetwork, repeats: int, seed: int) -> dict[str, float]:
    """Median seconds to sample the same videos by CPS and by DynDiff (mask included), alternating, and their ratio.

    mask_s: of computing the masks of one such rollout, alone.
    """
    arms = {"cps": sampler_arm("CPS", SamplerSettings("cps", 0.6)), "dyndiff": sampler_arm("DynDiff", dyndiff(0.6))}
    times: dict[str, list[float]] = {name: [] for name in (*arms, "mask")}
    scenes = draw_scenes(SCENES, seed, "cost")
    for _ in range(repeats):
        for name, arm in arms.items():
            start = time.perf_counter()
            buffer, _ = sample_groups(model, arm, scenes, GROUP, seed, 0, 0)
            times[name].append(time.perf_counter() - start)
        latents, settings = buffer.rollout.latents, arms["dyndiff"].rollout.sampler.mask
        start = time.perf_counter()
        for _ in buffer.rollout.steps:
            dynamic_mask(latents, buffer.condition.num_conditioning, settings)
        times["mask"].append(time.perf_counter() - start)
    found = {f"{name}_s": median(values) for name, values in times.items()}
    return {**found, "dyndiff_over_cps": found["dyndiff_s"] / found["cps_s"]}
