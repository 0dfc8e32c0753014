"""Claim B: what each sampler makes of the same number of model calls, on the moving disc. Section 5.3.

Shapes: N videos of one iteration, in groups of one scene each.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from wm_nodes.benchmark.moving_disc import CHANNELS, FRAMES, SIDE, Scenes, Scores, draw_scenes, score
from wm_nodes.benchmark.video_arms import NUM_STEPS, SHIFT, Arm
from wm_nodes.learning.video_grpo import BufferReport, GrpoLearner
from wm_nodes.rl.hacking import hacked_metrics
from wm_nodes.seeding import stream_seed
from wm_nodes.video_model import (
    RolloutBuffer,
    RolloutSettings,
    VideoNetwork,
    VideoRollout,
    config_hash,
    initial_noise,
    sample_videos,
)

SHAPE = (CHANNELS, FRAMES, SIDE, SIDE)
MAX_SEED = 2**62
MIN_EVALUATIONS = 4


@dataclass(frozen=True)
class LearningPlan:
    """iterations: buffers. scenes x group_size videos each. eval_scenes: held out, sampled by ODE. hackable: reward the
    task alone, which the detector of (2) should catch.
    """

    iterations: int = 40
    scenes: int = 6
    group_size: int = 8
    eval_scenes: int = 100
    eval_every: int = 5
    hackable: bool = False


def train_arm(
    model: VideoNetwork, arm: Arm, plan: LearningPlan, seed: int,
    on_iteration: Callable[[], object] = lambda: None,
) -> dict[str, Any]:  # fmt: skip
    """Post-train `model` in place; return the arm's curve: evaluations, buffer reports, seconds."""
    learner = GrpoLearner(model, arm.grpo, arm.rollout, seed=seed)
    evaluations = [{"iteration": 0, **evaluate(model, plan.eval_scenes, seed)}]
    buffers, seconds = list[dict[str, Any]](), {"rollout": 0.0, "train": 0.0}
    for iteration in range(plan.iterations):
        start = time.perf_counter()
        scenes = draw_scenes(plan.scenes, seed, "rollouts", iteration)
        buffer, scores = sample_groups(model, arm, scenes, plan.group_size, seed, iteration, learner.version)
        reward = scores.task if plan.hackable else scores.reward
        middle = time.perf_counter()
        report = learner.train(buffer.with_rewards({"total": reward}))
        seconds["rollout"] += middle - start
        seconds["train"] += time.perf_counter() - middle
        buffers.append({"iteration": iteration, **_flat(report), **_means(scores, "rollout_")})
        if (iteration + 1) % plan.eval_every == 0 or iteration + 1 == plan.iterations:
            evaluations.append({"iteration": iteration + 1, **evaluate(model, plan.eval_scenes, seed)})
        on_iteration()
    return {
        "arm": arm.name, "seed": seed, "evaluations": evaluations, "buffers": buffers, "seconds": seconds,
        "hacked": hacked(evaluations, "task" if plan.hackable else "reward"),
    }  # fmt: skip


def hacked(evaluations: list[dict[str, float]], proxy: str) -> list[str]:
    """Held-out truths that fell while the training reward rose, equation (2), over all evaluations."""
    if len(evaluations) < MIN_EVALUATIONS:
        return []
    truths = {name: [row[name] for row in evaluations] for name in ("obeyed", "mass")}
    truths["background"] = [-row["background"] for row in evaluations]
    found = hacked_metrics([row[proxy] for row in evaluations], truths, window=len(evaluations))
    return [alarm.metric for alarm in found]


def sample_groups(
    model: VideoNetwork, arm: Arm, scenes: Scenes, group_size: int, seed: int, iteration: int, version: int
) -> tuple[RolloutBuffer, Scores]:
    """Sample group_size videos of every scene and score them."""
    index = torch.arange(len(scenes)).repeat_interleave(group_size)
    repeated = select(scenes, index)
    samples = torch.arange(group_size).repeat(len(scenes))
    noise_of = index * group_size if arm.shared_noise else index * group_size + samples
    noise = initial_noise(SHAPE, seeds_of(seed, "initial", iteration, noise_of))
    steps = seeds_of(seed, "steps", iteration, index * group_size + samples)
    model.eval()
    rollout = sample_videos(model, repeated.condition(), noise, steps, arm.rollout)
    buffer = RolloutBuffer(
        rollout, repeated.condition(), index, samples, {}, torch.ones(len(index), dtype=torch.bool), version, iteration,
        config_hash(arm.rollout),
    )  # fmt: skip
    return buffer, score(rollout.latents, repeated)


def evaluate(model: VideoNetwork, count: int, seed: int) -> dict[str, float]:
    """Held-out scenes, sampled by ODE: mean scores."""
    scenes = draw_scenes(count, seed, "evaluation")
    rollout = ode_videos(model, scenes, seed)
    return _means(score(rollout.latents, scenes))


def ode_videos(model: VideoNetwork, scenes: Scenes, seed: int) -> VideoRollout:
    seeds = seeds_of(seed, "evaluation", 0, torch.arange(len(scenes)))
    model.eval()
    settings = RolloutSettings(NUM_STEPS, SHIFT, micro_batch=64)
    return sample_videos(model, scenes.condition(), initial_noise(SHAPE, seeds), seeds, settings, stochastic=[])


def seeds_of(seed: int, name: str, iteration: int, numbers: Tensor) -> Tensor:
    return torch.tensor([stream_seed(seed, f"moving_disc_{name}", iteration, int(n)) % MAX_SEED for n in numbers])


def select(scenes: Scenes, index: Tensor) -> Scenes:
    return Scenes(scenes.background[index], scenes.start[index], scenes.speed[index], scenes.action[index])


def _means(scores: Scores, prefix: str = "") -> dict[str, float]:
    names = ("reward", "task", "mass", "background", "obeyed")
    return {prefix + name: float(getattr(scores, name).mean()) for name in names}


def _flat(report: BufferReport) -> dict[str, Any]:
    return asdict(report)
