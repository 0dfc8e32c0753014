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

ANCHORS: tuple[Anchor, ...] = ("buffer", "frozen", "dual")
SCENES, GROUP = 4, 8


def measure_anchors(model: VideoNetwork, learner: GrpoSettings, repeats: int, seed: int) -> list[dict[str, Any]]:
    """One row per anchor: median seconds of training and of the KL on one buffer, turn by turn, and the bytes kept."""
    arm = sampler_arm("DynDiff", dyndiff(0.4, "sparse", "rms"), learner)
    buffer, scores = sample_groups(model, arm, draw_scenes(SCENES, seed, "cost"), GROUP, seed, 0, 0)
    buffer = buffer.with_rewards({"total": scores.reward})
    times: dict[str, list[tuple[float, float]]] = {anchor: [] for anchor in ANCHORS}
    for _ in range(repeats):
        for anchor in ANCHORS:
            kl = replace(learner.kl, anchor=anchor, dual_every=1)
            grpo = GrpoLearner(model, replace(learner, kl=kl, learning_rate=0.0), arm.rollout, seed=seed)
            report = grpo.train(buffer)
            times[anchor].append(
                (sum(u.train_seconds + u.kl_seconds for u in report.updates), sum(u.kl_seconds for u in report.updates))
            )
    weights = sum(p.nbytes for p in model.parameters())
    zeta = 0 if buffer.rollout.zeta is None else buffer.rollout.zeta.nbytes
    kept = {"buffer": zeta + buffer.rollout.mask.nbytes, "frozen": weights}
    kept["dual"] = kept["buffer"] + weights
    return [
        {
            "anchor": anchor, "train_s": median(total for total, _ in times[anchor]),
            "kl_s": median(kl for _, kl in times[anchor]), "bytes": kept[anchor],
        }
        for anchor in ANCHORS
    ]  # fmt: skip


def measure_rollout(model: VideoNetwork, repeats: int, seed: int) -> dict[str, float]:
    """Median seconds to sample the same videos by CPS and by DynDiff (mask included), alternating, and their ratio."""
    arms = {"cps": sampler_arm("CPS", SamplerSettings("cps", 0.6)), "dyndiff": sampler_arm("DynDiff", dyndiff(0.6))}
    times: dict[str, list[float]] = {name: [] for name in arms}
    scenes = draw_scenes(SCENES, seed, "cost")
    for _ in range(repeats):
        for name, arm in arms.items():
            start = time.perf_counter()
            sample_groups(model, arm, scenes, GROUP, seed, 0, 0)
            times[name].append(time.perf_counter() - start)
    found = {f"{name}_s": median(values) for name, values in times.items()}
    return {**found, "dyndiff_over_cps": found["dyndiff_s"] / found["cps_s"]}
