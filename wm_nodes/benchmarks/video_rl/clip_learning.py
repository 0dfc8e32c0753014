"""Learning on clips of recorded contexts: what each sampler makes of the same number of model calls.

The setting is the one of docs/dyndiff.md in which the shipped video model was seen to learn: contexts it has not been
trained on, clips of few steps, only the weights that carry the condition, no KL.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.video_rl.learning import follow_training
from benchmarks.video_rl.samplers import SHIFT, SamplerSetup, dyndiff
from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import RolloutConfig
from wm_nodes.video_model import RolloutBuffer, RolloutSettings, SamplerSettings
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.reference_reward import mixed, score_clips
from wm_nodes.video_rl.sampling import ClipGenerator
from wm_nodes.video_rl.training_run import rewarded
from wm_nodes.video_rl.validation import context_scores
from wm_nodes.world_model.position_probe import PositionProbe

MEASURES = ("tracking_path", "tracking", "object_cm", "tool_cm", "psnr_db")
TASK = "push_cube"
NUM_STEPS = 4
REWARDS = {"tracking": 1.0, "object_cm": -0.1}
BASE = load_video_config("base", {"task": TASK, "rewards": REWARDS})
LEARNER = BASE.grpo.with_values(
    advantage=BASE.grpo.advantage.with_values(std_scope="global", best_of_n=4),
    kl=BASE.grpo.kl.with_values(mode="none"), trains="condition", logprob_weight="cps", updates_per_buffer=1,
    step_fraction=1.0, learning_rate=2e-4, weight_decay=0.0,
)


@dataclass(frozen=True)
class ClipPlan:
    """iterations: buffers of contexts x group_size clips. eval_contexts: held out, one ODE clip each, before, every
    eval_every buffers, and at the end.
    """

    iterations: int = 8
    contexts: int = 16
    group_size: int = 8
    eval_contexts: int = 100
    eval_every: int = 2


def clip_learning_samplers() -> list[SamplerSetup]:
    """CPS and DynDiff at one eta, CPS at the noise that DynDiff spends on these clips, and DynDiff as written."""
    samplers = {
        "CPS 0.6": SamplerSettings("cps", 0.6),
        "CPS 0.4": SamplerSettings("cps", 0.4),
        "DynDiff 0.6 gated, rms": dyndiff(0.6, "gated", "rms"),
        "DynDiff 0.6 gated": dyndiff(0.6),
    }
    return [
        SamplerSetup(name, RolloutSettings(NUM_STEPS, SHIFT, sampler=sampler), LEARNER, shared_noise=True)
        for name, sampler in samplers.items()
    ]


def train_on_clips(
    folder: VideoFolder, contexts: Clips, heldout: Clips, probe: PositionProbe, arm: SamplerSetup, plan: ClipPlan,
    seed: int,
    on_iteration: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Post-train folder.network in place; return follow_training's row, and the held-out scores of every context
    before and after.
    """
    groups = {"contexts": plan.contexts, "group_size": plan.group_size, "shared_noise": arm.shared_noise}
    config = BASE.with_values(
        seed=seed, groups=groups, window=arm.window, grpo=arm.grpo,
        rollout=RolloutConfig.model_validate(arm.rollout, from_attributes=True),
        evaluation=BASE.evaluation.with_values(contexts=plan.eval_contexts, num_steps=NUM_STEPS),
    )
    generator = ClipGenerator(folder, contexts, config)
    learner = GrpoLearner(folder.network, arm.grpo, arm.rollout, seed=seed)

    def evaluate() -> dict[str, Any]:
        return {name: values.tolist() for name, values in context_scores(folder, heldout, probe, config).items()}

    def sample(iteration: int, version: int) -> tuple[RolloutBuffer, Callable[[], dict[str, float]]]:
        request = generator.request(iteration, version)
        buffer = generator.sample(request)
        frames = folder.codec.decode(buffer.rollout.latents)
        scores = score_clips(frames, generator.references(request), probe, folder.clip["num_conditioning"]).named()
        return rewarded(buffer, scores, mixed(scores, REWARDS)), dict

    row = follow_training(learner, plan.iterations, plan.eval_every, sample, evaluate, on_iteration)
    found = row["evaluations"]
    return {
        "arm": arm.name, "shared_noise": arm.shared_noise, "seed": seed, "plan": asdict(plan),
        **row, "before": found[0], "after": found[-1], "evaluations": [_means(one) for one in found],
    }


def _means(found: dict[str, Any]) -> dict[str, Any]:
    return {name: sum(v) / len(v) if isinstance(v, Sequence) else v for name, v in found.items()}
