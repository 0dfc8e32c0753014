"""What is trained to answer one question each: the paper's ablations, and a reward that can be hacked.

Each ablation is a pair on one learner and one sampler, with equal model calls.
"""

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from benchmarks.video_rl.samplers import DiscPlan, LearningPlan, SamplerSetup, by_arm, dyndiff, sampler_setup
from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import GrpoConfig

GUIDANCE = 2.0
HIGH_SIDE = 20
SHORT_RATE = 2e-4
"""Learning rate of these short trainings, twice that of the learning experiment: 12 buffers go as far as 24."""
PAPER_GROUP = 16
"""Videos per context of Table 5: a clip of 2.5 can act from groups of 8 on, one of 5 only from 27 on."""
Plan = TypeVar("Plan", bound=LearningPlan)


@dataclass(frozen=True)
class SamplerTrial(Generic[Plan]):
    """One sampler trained by one plan; the sampler's name is the trial's."""

    sampler: SamplerSetup
    plan: Plan


def ablation_trials(learner: GrpoConfig, plan: DiscPlan) -> tuple[list[SamplerTrial[DiscPlan]], list[tuple[str, str]]]:
    """Return the trainings, and which is compared with which: (name, name of its base)."""
    cps = learner.with_values(logprob_weight="cps", learning_rate=SHORT_RATE)
    base = replace(sampler_setup("base", dyndiff(0.6, "gated", "rms"), cps), shared_noise=True)
    groups = replace(plan, contexts=max(1, plan.contexts * plan.group_size // PAPER_GROUP), group_size=PAPER_GROUP)
    half = replace(plan, iterations=max(1, plan.iterations // 2), eval_every=max(1, plan.eval_every // 2))
    high = replace(plan, eval_side=HIGH_SIDE)
    guided, plain = base.rollout.with_values(cfg=GUIDANCE), load_video_config("base").grpo
    wide = plain.advantage.with_values(clip=5.0)
    other_kl = plain.kl.with_values(mode="logk2", beta=learner.kl.beta)
    trials = [
        SamplerTrial(base, plan),
        SamplerTrial(_learning(base, "KL of log-probabilities", kl=other_kl), plan),
        SamplerTrial(_learning(base, "no KL", kl=plain.kl.with_values(beta=0.0)), plan),
        SamplerTrial(_learning(base, "clip 2.5, groups of 16"), groups),
        SamplerTrial(_learning(base, "clip 5, groups of 16", advantage=wide), groups),
        SamplerTrial(replace(base, name="guidance 2", rollout=guided), half),  # two calls per step
        SamplerTrial(replace(base, name="trained at 16, shown at 20"), high),
        SamplerTrial(replace(base, name="trained and shown at 20"), replace(high, side=HIGH_SIDE)),
    ]
    pairs = [
        ("KL of log-probabilities", "base"), ("no KL", "base"), ("clip 5, groups of 16", "clip 2.5, groups of 16"),
        ("guidance 2", "base"), ("trained and shown at 20", "trained at 16, shown at 20"),
    ]
    return trials, pairs


def hacking_trials(learner: GrpoConfig, plan: DiscPlan) -> list[SamplerTrial[DiscPlan]]:
    """The honest reward; temporal consistency alone, which a picture that stands still, or has no disc, satisfies best;
    the same with a frozen anchor, which holds it back."""
    cps = learner.with_values(logprob_weight="cps", learning_rate=SHORT_RATE)
    sampler = replace(sampler_setup("honest reward", by_arm("cps", 0.6), cps), shared_noise=True)
    hackable, frozen = replace(plan, proxy="consistency"), learner.kl.with_values(anchor="frozen")
    return [
        SamplerTrial(sampler, plan),
        SamplerTrial(_learning(sampler, "consistency alone"), hackable),
        SamplerTrial(_learning(sampler, "consistency, frozen anchor", kl=frozen), hackable),
    ]


def _learning(sampler: SamplerSetup, name: str, **changes: object) -> SamplerSetup:
    return replace(sampler, name=name, grpo=sampler.grpo.with_values(**changes))
