"""Cost: what each KL anchor costs in seconds and bytes, side by side on the same buffers, and what the mask and
caching add to a rollout. DD-20.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.experiment import Count, OnDevice, console
from benchmarks.video_rl import tables
from benchmarks.video_rl.clock import clocked
from benchmarks.video_rl.discs import base_of
from benchmarks.video_rl.samplers import LEARNER, dyndiff, sampler_setup
from benchmarks.video_rl.sources import sample_scenes
from wm_nodes.config.load import load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import Anchor, GrpoConfig, RolloutConfig
from wm_nodes.core.device import device_of, synchronize
from wm_nodes.core.seeding import torch_stream
from wm_nodes.video_model import (
    Condition,
    RolloutBuffer,
    VideoNetwork,
    kernels,
    sampling,
)
from wm_nodes.video_model.buffer import config_hash
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.toy_scene import CHANNELS, FRAMES, SIDE, draw_scenes, load_base

ANCHORS: tuple[Anchor, ...] = ("buffer", "frozen", "dual")
PARTS = ("forward", "kl", "backward")
CACHING = ("keep_state", "keep_transition")
SCENES, GROUP = 4, 8
CLIP_FRAMES = 9
"""Of PushCube: every second of the 17 pictures of an episode."""


@dataclass(kw_only=True)
class Cost(OnDevice):
    """Seconds and bytes of the KL anchors, and of mask and caching."""

    repeats: Count = 7
    """Turns, of which the median counts."""
    base_model: Path | None = None
    """Weights of another base model of the moving disc than the shipped one."""
    seed: int = 0
    """Of the buffers."""

    def run(self) -> None:
        model, repeats, seed = load_base(self.base_model, self.where), self.repeats, self.seed
        rollouts = [toy_rollout(model, repeats, seed), pushcube_rollout(repeats, seed, self.where)]
        rows = [
            *measure_anchors("moving disc", model, toy_buffer(model, seed), LEARNER, repeats),
            *measure_anchors("PushCube", *pushcube_buffer(seed, self.where), LEARNER, repeats),
        ]
        facts = {"seed": seed, "learner": LEARNER.model_dump(), **base_of(self.base_model)}
        self.write({**facts, "rollouts": rollouts, "rows": rows})
        console.print(tables.rollout_table(rollouts, repeats), tables.cost_table(rows, repeats))


def measure_anchors(
    name: str, model: VideoNetwork, sampled: tuple[RolloutBuffer, RolloutConfig], learner: GrpoConfig, repeats: int
) -> list[dict[str, Any]]:
    """One row per anchor: median seconds of each part of training on one buffer, turn by turn, and the bytes kept.

    sampled: the buffer and how it was sampled.
    """
    buffer, rollout = sampled
    times: dict[str, dict[str, list[float]]] = {anchor: {part: [] for part in PARTS} for anchor in ANCHORS}
    for _ in range(repeats):
        for anchor in ANCHORS:
            kl = learner.kl.with_values(anchor=anchor, dual_every=1)
            grpo = GrpoLearner(model, learner.with_values(kl=kl, learning_rate=0.0), rollout, seed=0)
            device = device_of(model)
            with (
                clocked(grpo.terms, "compute", device=device) as terms,
                clocked(grpo.terms, "kl", device=device) as kl_alone,
                clocked(torch.Tensor, "backward", device=device) as backward,
            ):
                grpo.train(buffer)
            for part, spent in zip(PARTS, (terms[0] - kl_alone[0], kl_alone[0], backward[0]), strict=True):
                times[anchor][part].append(spent)
    weights = sum(p.nbytes for p in model.parameters())
    kept = {"buffer": buffer.rollout.zeta.nbytes + buffer.rollout.mask.nbytes, "frozen": weights}
    kept["dual"] = kept["buffer"] + weights
    return [
        {
            "model": name, "anchor": anchor, "bytes": kept[anchor],
            **{f"{part}_s": median(times[anchor][part]) for part in PARTS},
        }
        for anchor in ANCHORS
    ]


def measure_rollout(
    network: VideoNetwork, condition: Condition, shape: tuple[int, ...], rollout: RolloutConfig, repeats: int,
    seed: int,
) -> dict[str, float]:
    """What the mask and caching add to sampling the videos of `condition`, latents of `shape` (C, F, H, W).

    rollout_s: median seconds of a whole rollout with the DynDiff sampler of `rollout`. cps_s: with CPS at the same eta,
    turn by turn. mask_share, cache_share: median share of a DynDiff rollout that went into its masks, and into keeping
    states, masks and noise; measured inside that rollout, so the machine's noise moves them less than the ratio.
    """
    cps = rollout.with_values(sampler=rollout.sampler.with_values(arm="cps"))
    seeds = torch.arange(len(condition.frames)) + seed
    device = device_of(network)
    condition, noise = condition.to(device), sampling.initial_noise(shape, seeds).to(device)
    found: dict[str, list[float]] = {"cps_s": [], "rollout_s": [], "mask_share": [], "cache_share": []}
    network.eval()
    for turn in range(repeats + 1):  # the first one warms up
        for name, settings in (("cps_s", cps), ("rollout_s", rollout)):
            with (
                clocked(kernels, "rollout_mask", device=device) as mask,
                clocked(sampling, *CACHING, device=device) as caching,
            ):
                synchronize(device)
                start = time.perf_counter()
                sampling.sample_videos(network, condition, noise, seeds, settings)
                synchronize(device)
                total = time.perf_counter() - start
            if turn:
                found[name].append(total)
        if turn:
            found["mask_share"].append(mask[0] / total)
            found["cache_share"].append(caching[0] / total)
    medians = {name: median(values) for name, values in found.items()}
    return {**medians, "over_cps": medians["rollout_s"] / medians["cps_s"]}


def toy_rollout(model: VideoNetwork, repeats: int, seed: int) -> dict[str, Any]:
    """measure_rollout of the moving disc: SCENES x GROUP videos, DynDiff 0.6 gated."""
    condition = draw_scenes(SCENES, seed, "cost").condition().repeat_interleave(GROUP)
    shape = (CHANNELS, FRAMES, SIDE, SIDE)
    settings = sampler_setup("DynDiff", dyndiff(0.6)).rollout
    return {"model": "moving disc", **measure_rollout(model, condition, shape, settings, repeats, seed)}


def toy_buffer(model: VideoNetwork, seed: int) -> tuple[RolloutBuffer, RolloutConfig]:
    """SCENES x GROUP scored videos of the moving disc, DynDiff 0.4 sparse at an rms budget."""
    sampler = sampler_setup("DynDiff", dyndiff(0.4, "sparse", "rms"))
    return sample_scenes(model, sampler, draw_scenes(SCENES, seed, "cost"), GROUP, seed), sampler.rollout


def pushcube_rollout(repeats: int, seed: int, device: torch.device) -> dict[str, Any]:
    """measure_rollout of the shipped PushCube network by the recommended preset."""
    network, condition, shape, rollout = _pushcube(seed, device)
    return {"model": "PushCube", **measure_rollout(network, condition, shape, rollout, repeats, seed)}


def pushcube_buffer(seed: int, device: torch.device) -> tuple[VideoNetwork, tuple[RolloutBuffer, RolloutConfig]]:
    """The shipped PushCube network and SCENES x GROUP of its videos with random rewards, by the recommended preset."""
    network, condition, shape, rollout = _pushcube(seed, device)
    index = torch.arange(SCENES * GROUP)
    noise = sampling.initial_noise(shape, index + seed).to(device)
    videos = sampling.sample_videos(network, condition, noise, index + seed, rollout)
    rewards = torch.rand(len(index), generator=torch_stream(seed, "cost_rewards"), dtype=torch.float64)
    buffer = RolloutBuffer(videos, condition, index // GROUP, index % GROUP, {}, 0, 0, config_hash(rollout))
    return network, (buffer.with_rewards({"total": rewards}), rollout)


def _pushcube(seed: int, device: torch.device) -> tuple[VideoNetwork, Condition, tuple[int, ...], RolloutConfig]:
    """The shipped network, what it is asked for, the shape of its latents, and how it samples; given frames and actions
    are random, because times depend on sizes only."""
    config = load_video_config("recommended")
    folder = load_video_folder(shipped_model(config.task) / "video_model", device)
    settings, codec, videos, frames = folder.network.settings, folder.manifest["codec"], SCENES * GROUP, CLIP_FRAMES
    H, W = (codec[side] // codec["config"]["patch_px"] for side in ("height", "width"))
    draw = partial(torch.randn, generator=torch_stream(seed, "cost"))
    condition = Condition(
        draw(videos, settings.channels, folder.clip["num_conditioning"], H, W),
        draw(videos, frames - 1, settings.action_dim), draw(videos, 4, settings.text_dim),
    )
    shape = (settings.channels, frames, H, W)
    return folder.network.eval(), condition.to(device), shape, config.rollout
