"""The competing samplers of the DynDiff benchmark, by name; everything else of a run is shared by all arms."""

from dataclasses import dataclass, replace

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import GrpoConfig, WindowConfig
from wm_nodes.video_model import MaskSettings, RolloutSettings, SamplerSettings

NUM_STEPS, SHIFT = 10, 3.0
_BASE = load_video_config("base")


@dataclass(frozen=True)
class SamplerSetup:
    """One sampler with the learner settings that belong to it. shared_noise: one initial noise for a whole group.
    window: which of its steps are stochastic.
    """

    name: str
    rollout: RolloutSettings
    grpo: GrpoConfig
    shared_noise: bool = False
    window: WindowConfig = _BASE.window


def sampler_setup(name: str, sampler: SamplerSettings, grpo: GrpoConfig | None = None) -> SamplerSetup:
    return SamplerSetup(
        name, RolloutSettings(NUM_STEPS, SHIFT, sampler=sampler, micro_batch=64), grpo or _BASE.grpo
    )


def dyndiff(eta: float, combine: str = "gated", budget: str = "literal", **knobs: object) -> SamplerSettings:
    mask = MaskSettings(combine=combine, budget=budget, **knobs)  # type: ignore[arg-type]
    return SamplerSettings("dyndiff", eta, mask=mask)


def diversity_samplers() -> list[SamplerSetup]:
    """For diversity: ODE, CPS at several noise levels, DynDiff as written, sparse, and at CPS's noise budget."""
    arms = [sampler_setup("ODE", SamplerSettings("ode", 0.0))]
    arms += [sampler_setup(f"CPS {eta:g}", SamplerSettings("cps", eta)) for eta in (0.2, 0.4, 0.6)]
    arms += [sampler_setup(f"DynDiff {eta:g} gated", dyndiff(eta)) for eta in (0.6, 1.0)]
    arms += [sampler_setup("DynDiff 0.6 sparse", dyndiff(0.6, "sparse"))]
    for eta in (0.2, 0.4, 0.6):
        arms += [
            sampler_setup(f"DynDiff {eta:g} {kind}, rms", dyndiff(eta, kind, "rms")) for kind in ("gated", "sparse")
        ]
    return arms


def learning_samplers(learner: GrpoConfig) -> list[SamplerSetup]:
    """Learning: every arm on one learner; `learner` holds what they share.

    Mix-GRPO and the arms "window" train all four steps of a window that moves, as many as the others do of their nine.
    """
    cps = learner.with_values(logprob_weight="cps")
    frozen = _BASE.grpo.kl.with_values(beta=learner.kl.beta, anchor="frozen")
    plain = sampler_setup("CPS 0.6", SamplerSettings("cps", 0.6), cps)
    matched = sampler_setup("DynDiff 0.4 sparse, rms, cps", dyndiff(0.4, "sparse", "rms"), cps)
    sparse = sampler_setup("DynDiff 0.6 sparse, cps", dyndiff(0.6, "sparse"), cps)
    gated = sampler_setup("DynDiff 0.6 gated, rms, cps", dyndiff(0.6, "gated", "rms"), cps)
    quiet = [
        sampler_setup("CPS 0.46", SamplerSettings("cps", 0.46), cps),  # spends what DynDiff 0.6 gated, rms does
        sampler_setup("CPS 0.2", SamplerSettings("cps", 0.2), cps),
        sampler_setup("DynDiff 0.2 sparse, rms, cps", dyndiff(0.2, "sparse", "rms"), cps),
    ]
    shared = (plain, matched, sparse, gated, *quiet)
    mix = _in_window(sampler_setup("Flow-GRPO 0.7", SamplerSettings("flow", 0.7), learner))
    return [
        plain,
        sampler_setup("CPS 0.6, full", SamplerSettings("cps", 0.6), learner),
        sampler_setup("Flow-GRPO 0.7", SamplerSettings("flow", 0.7), learner),
        replace(mix, name="Mix-GRPO 0.7"),
        sampler_setup("DanceGRPO 0.3", SamplerSettings("dance", 0.3), learner),
        sampler_setup("SAGE 0.5", SamplerSettings("sage", 0.5), learner),
        sampler_setup("DynDiff 0.6 gated", dyndiff(0.6), learner),
        sampler_setup("DynDiff 0.6 sparse", dyndiff(0.6, "sparse"), learner),
        sampler_setup("DynDiff 0.4 sparse, rms", dyndiff(0.4, "sparse", "rms"), learner),
        matched,
        sparse,
        gated,
        *(replace(arm, name=f"{arm.name}, frozen", grpo=arm.grpo.with_values(kl=frozen)) for arm in (plain, matched)),
        *(replace(arm, name=f"{arm.name}, shared", shared_noise=True) for arm in shared),
        *(replace(_in_window(arm), name=f"{arm.name}, window") for arm in (plain, gated)),
    ]


def _in_window(arm: SamplerSetup) -> SamplerSetup:
    window = WindowConfig(strategy="progressive", size=4, period=7)
    return replace(arm, grpo=arm.grpo.with_values(step_fraction=1.0), window=window, shared_noise=True)
