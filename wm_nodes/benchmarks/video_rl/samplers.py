"""The competing samplers of the DynDiff benchmark, by name; everything else of a run is shared by all samplers."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import GrpoConfig, RolloutConfig, SamplerConfig, WindowConfig
from wm_nodes.video_rl.toy_scene import SIDE

NUM_STEPS, CLIP_STEPS, SHIFT = 10, 4, 3.0
NFT_RATE = 2e-4
"""Learning rate of the objective nft on the moving disc, the better one of 1e-4 and 2e-4 on seed 0."""
BASE = load_video_config("base")
LEARNER = BASE.grpo.with_values(learning_rate=1e-4, micro_batch=64)
"""Table 5's clip, advantage clip, KL and step fraction; a learning rate for 76 k parameters instead of billions."""
CLIP_LEARNER = BASE.grpo.with_values(
    advantage=BASE.grpo.advantage.with_values(std_scope="global", best_of_n=4),
    kl=BASE.grpo.kl.with_values(beta=0.0), trains="condition", logprob_weight="cps", updates_per_buffer=1,
    step_fraction=1.0, learning_rate=2e-4, weight_decay=0.0,
)
"""The setting in which the shipped video model was seen to learn from recorded contexts that it was not trained on:
clips of few steps, only the weights that carry the condition, no KL."""


QUIET_ETA = 0.173
"""CPS spends as much noise by it as DynDiff by 0.6 in the paper's settings."""
PAPER_RATES = {
    "DynDiff 0.6": 3e-4, "CPS 0.6": 1e-4, f"CPS {QUIET_ETA}": 3e-4, "Flow-GRPO 0.7": 1e-4, "DanceGRPO 0.3": 1e-3,
    "SAGE 0.5": 3e-4,
}
"""Learning rate in the paper's settings: of a half-decade grid from 3e-5 to 3e-3 the one with the highest reward of the
last three of six buffers, 4 first frames each, of a pilot seed. Other samplers were not tried and take OTHER_RATE."""
OTHER_RATE = 1e-4


@dataclass(frozen=True)
class LearningPlan:
    """How long one training is, and how it is measured."""

    iterations: int = 8
    """Buffers of contexts x group_size videos."""
    contexts: int = 16
    """Of a buffer."""
    group_size: int = 8
    """Videos of each context."""
    eval_contexts: int = 100
    """Held out, one video each by ODE, before, every eval_every buffers, and at the end."""
    eval_every: int = 2
    """Buffers."""


@dataclass(frozen=True)
class DiscPlan(LearningPlan):
    """Of the moving disc."""

    iterations: int = 40
    """Buffers."""
    contexts: int = 6
    """Scenes of a buffer."""
    eval_every: int = 5
    """Buffers."""
    proxy: Literal["reward", "consistency"] = "reward"
    """The score that trains, `reward` or one that can be hacked."""
    side: int = SIDE
    """Of the videos that train, px."""
    eval_side: int = SIDE
    """Of the held-out ones, px."""


@dataclass(frozen=True)
class SamplerSetup:
    """One sampler with the learner settings that belong to it."""

    name: str
    """In the results."""
    rollout: RolloutConfig
    """How it samples."""
    grpo: GrpoConfig
    """How it is trained."""
    shared_noise: bool = False
    """One initial noise for a whole group."""
    window: WindowConfig = BASE.window
    """Which of its steps are stochastic."""


def sampler_setup(name: str, sampler: SamplerConfig, grpo: GrpoConfig | None = None) -> SamplerSetup:
    return SamplerSetup(name, rollout_by(sampler, num_steps=NUM_STEPS, micro_batch=64), grpo or BASE.grpo)


def rollout_by(sampler: SamplerConfig, **changes: Any) -> RolloutConfig:
    """The base preset's, of CLIP_STEPS steps of SHIFT but for changes."""
    return BASE.rollout.with_values(**{"num_steps": CLIP_STEPS, "shift": SHIFT, "sampler": sampler, **changes})


def by_arm(arm: str, eta: float) -> SamplerConfig:
    return BASE.rollout.sampler.with_values(arm=arm, eta=eta)


def dyndiff(eta: float, combine: str = "gated", budget: str = "literal") -> SamplerConfig:
    mask = BASE.rollout.sampler.mask.with_values(combine=combine, budget=budget)
    return BASE.rollout.sampler.with_values(arm="dyndiff", eta=eta, mask=mask)


def diversity_samplers() -> list[SamplerSetup]:
    """For diversity: ODE, CPS at several noise levels, DynDiff's literal mask, sparse, and at CPS's noise budget."""
    return [
        sampler_setup("ODE", by_arm("ode", 0.0)),
        *(sampler_setup(f"CPS {eta:g}", by_arm("cps", eta)) for eta in (0.2, 0.4, 0.6)),
        *(sampler_setup(f"DynDiff {eta:g} gated", dyndiff(eta)) for eta in (0.6, 1.0)),
        sampler_setup("DynDiff 0.6 sparse", dyndiff(0.6, "sparse")),
        *(
            sampler_setup(f"DynDiff {eta:g} {kind}, rms", dyndiff(eta, kind, "rms"))
            for eta in (0.2, 0.4, 0.6) for kind in ("gated", "sparse")
        ),
    ]


def learning_samplers(learner: GrpoConfig) -> list[SamplerSetup]:
    """Learning: every sampler on one learner; `learner` holds what they share.

    Mix-GRPO and the samplers "window" train all four steps of a window that moves, as many as the others of their nine.
    "signed FM" (DD-31) trains at three times: with a call of the old weights each they cost what the
    others' four steps do, a call with its gradient counted as three.
    """
    nft = learner.with_values(
        objective="nft", nft=learner.nft.with_values(times=3), kl=learner.kl.with_values(beta=0.0),
        learning_rate=NFT_RATE,
    )
    cps = learner.with_values(logprob_weight="cps")
    plain = sampler_setup("CPS 0.6", by_arm("cps", 0.6), cps)
    gated = sampler_setup("DynDiff 0.6 gated, rms, cps", dyndiff(0.6, "gated", "rms"), cps)
    quiet = sampler_setup("CPS 0.46", by_arm("cps", 0.46), cps)  # spends what DynDiff 0.6 gated, rms does
    flow = sampler_setup("Flow-GRPO 0.7", by_arm("flow", 0.7), learner)
    return [
        plain, sampler_setup("CPS 0.6, full", by_arm("cps", 0.6), learner),
        flow, replace(_in_window(flow), name="Mix-GRPO 0.7"),
        sampler_setup("DanceGRPO 0.3", by_arm("dance", 0.3), learner),
        sampler_setup("SAGE 0.5", by_arm("sage", 0.5), learner),
        sampler_setup("DynDiff 0.6 gated", dyndiff(0.6), learner), gated,
        *(replace(one, name=f"{one.name}, shared", shared_noise=True) for one in (plain, gated, quiet)),
        *(replace(_in_window(one), name=f"{one.name}, window") for one in (plain, gated)),
        sampler_setup("signed FM, ODE", by_arm("ode", 0.0), nft),
    ]


def clip_learning_samplers() -> list[SamplerSetup]:
    """Claim B on recorded contexts: CPS and DynDiff at one eta, CPS at the noise that DynDiff spends there, and DynDiff
    with its literal mask."""
    samplers = {
        "CPS 0.6": by_arm("cps", 0.6), "CPS 0.4": by_arm("cps", 0.4),
        "DynDiff 0.6 gated, rms": dyndiff(0.6, "gated", "rms"), "DynDiff 0.6 gated": dyndiff(0.6),
    }
    return [
        SamplerSetup(name, rollout_by(sampler), CLIP_LEARNER, shared_noise=True)
        for name, sampler in samplers.items()
    ]


def outcome_samplers(preset: str = "outcome") -> list[SamplerSetup]:
    """Of the outcome task, or of another preset: CPS, DynDiff at the noise that CPS 0.4 spends, both in a window,
    DynDiff with its literal mask, and DD-31 by ODE, whose clips differ in their initial noise: with one update
    on a buffer that is flow matching with signed weights ("signed FM"), not the paper's DiffusionNFT."""
    learner = load_video_config(preset).grpo
    samplers = {
        "CPS 0.4": by_arm("cps", 0.4), "DynDiff 0.54 gated, rms": dyndiff(0.54, "gated", "rms"),
        "DynDiff 0.6 gated": dyndiff(0.6),
    }
    plain = [
        SamplerSetup(name, rollout_by(sampler), learner, shared_noise=True)
        for name, sampler in samplers.items()
    ]
    windows = [replace(_in_window(sampler, size=2, period=1), name=f"{sampler.name}, window") for sampler in plain[:2]]
    ode = rollout_by(by_arm("ode", 0.0))
    nft = learner.with_values(objective="nft", nft=learner.nft.with_values(times=CLIP_STEPS - 1))
    return [*plain, *windows, SamplerSetup("signed FM, ODE", ode, nft)]


def paper_samplers() -> list[SamplerSetup]:
    """Of Table 5 (preset paper), each on its learner: full likelihood, a clip of 1e-4 at two updates on a buffer, the
    KL of DD-20, 8 of 16 clips, 55 % of 15 steps, initial noise of their own. CPS at DynDiff's eta, by its authors'
    weight of the likelihood, too, and at the noise that DynDiff spends. Mix-GRPO is Flow-GRPO in a window of four steps
    that begins with the first ones; DynDiff in it tells what is the window's.

    The numbers of a network call, of storage and the learning rate are of a small model.
    """
    paper = load_video_config("paper")
    learner = paper.grpo.with_values(micro_batch=128)
    rollout = paper.rollout.with_values(storage_dtype="float32", buffer_device="model", micro_batch=128)
    samplers = {
        "DynDiff 0.6": dyndiff(0.6), "CPS 0.6": by_arm("cps", 0.6), f"CPS {QUIET_ETA}": by_arm("cps", QUIET_ETA),
        "Flow-GRPO 0.7": by_arm("flow", 0.7), "DanceGRPO 0.3": by_arm("dance", 0.3), "SAGE 0.5": by_arm("sage", 0.5),
    }
    setups = [
        SamplerSetup(name, rollout.with_values(sampler=sampler),
                     learner.with_values(learning_rate=PAPER_RATES.get(name, OTHER_RATE)))
        for name, sampler in samplers.items()
    ]
    weighted = replace(setups[1], name="CPS 0.6, cps", grpo=setups[1].grpo.with_values(logprob_weight="cps"))
    windows = {"Mix-GRPO 0.7": setups[3], "DynDiff 0.6, window": setups[0]}
    return [*setups, weighted, *(
        replace(_in_window(setup), name=name, shared_noise=False) for name, setup in windows.items()
    )]


def _in_window(sampler: SamplerSetup, size: int = 4, period: int = 7) -> SamplerSetup:
    window = WindowConfig(strategy="progressive", size=size, period=period)
    return replace(sampler, grpo=sampler.grpo.with_values(step_fraction=1.0), window=window, shared_noise=True)
