"""Learning: what each sampler makes of the same number of model calls, on the moving disc.

Shapes: N videos of one iteration, in groups of one scene each.
"""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from benchmarks.video_rl.samplers import SamplerSetup
from wm_nodes.core.seeding import stream_seed
from wm_nodes.video_model import (
    RolloutBuffer,
    VideoNetwork,
    VideoRollout,
    config_hash,
    initial_noise,
    sample_videos,
    stochastic_steps,
)
from wm_nodes.video_rl.diversity import rollout_diversity
from wm_nodes.video_rl.group_advantages import group_advantages
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.reward_hacking import hacked_metrics
from wm_nodes.video_rl.toy_scene import CHANNELS, FRAMES, SIDE, Scenes, Scores, centred_pixels, draw_scenes, score
from wm_nodes.video_rl.training_run import flat_metrics

MAX_SEED = 2**62
MIN_EVALUATIONS = 4
DRIFTS = "background"
"""Gets worse in every training that has no frozen anchor, whatever the reward: named, and no sign of hacking."""


@dataclass(frozen=True)
class LearningPlan:
    """iterations: buffers. scenes x group_size videos each. eval_scenes: held out, sampled by ODE. proxy: the score
    that trains, `reward` or one that can be hacked. side, eval_side: of the videos that train and the held-out ones.
    """

    iterations: int = 40
    scenes: int = 6
    group_size: int = 8
    eval_scenes: int = 100
    eval_every: int = 5
    proxy: Literal["reward", "consistency"] = "reward"
    side: int = SIDE
    eval_side: int = SIDE


Sample = Callable[[int, int], tuple[RolloutBuffer, Callable[[], dict[str, float]]]]
"""(iteration, policy version) -> a buffer with rewards, and what is measured of it outside the clock."""


def train_sampler(
    model: VideoNetwork, arm: SamplerSetup, plan: LearningPlan, seed: int,
    on_iteration: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Post-train `model` in place; return follow_training's row, and what DD-2 names."""

    def sample(iteration: int, version: int) -> tuple[RolloutBuffer, Callable[[], dict[str, float]]]:
        scenes = draw_scenes(plan.scenes, seed, "rollouts", iteration, plan.side)
        buffer, scores = sample_groups(model, arm, scenes, plan.group_size, seed, iteration, version)
        buffer = buffer.with_rewards({"total": getattr(scores, plan.proxy)})
        return buffer, lambda: {
            **group_spread(buffer, plan.group_size), "advantage_max": _largest_advantage(buffer),
            **_means(scores, "rollout_"),
        }

    learner = GrpoLearner(model, arm.grpo, arm.rollout, seed=seed)
    row = follow_training(
        learner, plan.iterations, plan.eval_every, sample, lambda: evaluate(model, arm, plan, seed), on_iteration
    )
    named = {"arm": arm.name, "shared_noise": arm.shared_noise, "seed": seed, "plan": asdict(plan)}
    return {**named, **row, "hacked": hacked(row["evaluations"], plan.proxy)}


def follow_training(
    learner: GrpoLearner, iterations: int, eval_every: int, sample: Sample, evaluate: Callable[[], dict[str, Any]],
    on_iteration: Callable[[], object],
) -> dict[str, Any]:
    """Train on so many buffers; return what one training gave: evaluations (before, every eval_every buffers, and
    after), a list per quantity of the buffers, and seconds.
    """
    evaluations = [{"iteration": 0, **evaluate()}]
    buffers, seconds = list[dict[str, float]](), {"rollout": 0.0, "train": 0.0}
    for iteration in range(iterations):
        start = time.perf_counter()
        buffer, measured = sample(iteration, learner.version)
        middle = time.perf_counter()
        report = learner.train(buffer)
        seconds["rollout"] += middle - start
        seconds["train"] += time.perf_counter() - middle
        buffers.append({**flat_metrics(report), **measured()})
        if (iteration + 1) % eval_every == 0 or iteration + 1 == iterations:
            evaluations.append({"iteration": iteration + 1, **evaluate()})
        on_iteration()
    names = dict.fromkeys(name for row in buffers for name in row)  # a window's steps are not those of every buffer
    courses = {name: [row.get(name) for row in buffers] for name in names}
    return {"evaluations": evaluations, "buffers": courses, "seconds": seconds}


def hacked(evaluations: list[dict[str, float]], proxy: str) -> list[str]:
    """Held-out truths that got worse while the training reward rose, DD-2, over all evaluations.

    Worse is less obedience, a mass further from 1 (too much is as wrong as too little), more background error.
    """
    if len(evaluations) < MIN_EVALUATIONS:
        return []
    truths = {
        "obeyed": [row["obeyed"] for row in evaluations],
        "mass": [-abs(row["mass"] - 1) for row in evaluations],
        "background": [-row["background"] for row in evaluations],
    }
    found = hacked_metrics([row[proxy] for row in evaluations], truths, window=len(evaluations))
    return [alarm.metric for alarm in found]


def alarms(row: dict[str, Any]) -> list[str]:
    """What a training's reward was hacked at the cost of: its `hacked` metrics but the one that drifts anyway."""
    return [name for name in row["hacked"] if name != DRIFTS]


def sample_groups(
    model: VideoNetwork, arm: SamplerSetup, scenes: Scenes, group_size: int, seed: int, iteration: int, version: int
) -> tuple[RolloutBuffer, Scores]:
    """Sample group_size videos of every scene and score them."""
    index = torch.arange(len(scenes)).repeat_interleave(group_size)
    repeated = select(scenes, index)
    samples = torch.arange(group_size).repeat(len(scenes))
    noise_of = index * group_size if arm.shared_noise else index * group_size + samples
    noise = initial_noise(_shape(scenes), seeds_of(seed, "initial", iteration, noise_of))
    steps = seeds_of(seed, "steps", iteration, index * group_size + samples)
    model.eval()
    stochastic = stochastic_steps(arm.rollout.num_steps, arm.window, iteration, seed)
    rollout = sample_videos(model, repeated.condition(), noise, steps, arm.rollout, stochastic)
    buffer = RolloutBuffer(
        rollout, repeated.condition(), index, samples, {}, torch.ones(len(index), dtype=torch.bool), version, iteration,
        config_hash(arm.rollout),
    )
    return buffer, score(rollout.latents, repeated)


def evaluate(model: VideoNetwork, arm: SamplerSetup, plan: LearningPlan, seed: int) -> dict[str, float]:
    """Held-out scenes, sampled by ODE with the arm's guidance: mean scores."""
    scenes = draw_scenes(plan.eval_scenes, seed, "evaluation", side=plan.eval_side)
    return _means(score(ode_videos(model, arm, scenes, seed).latents, scenes))


def ode_videos(model: VideoNetwork, arm: SamplerSetup, scenes: Scenes, seed: int) -> VideoRollout:
    seeds = seeds_of(seed, "evaluation", 0, torch.arange(len(scenes)))
    model.eval()
    noise = initial_noise(_shape(scenes), seeds)
    return sample_videos(model, scenes.condition(), noise, seeds, arm.rollout, stochastic=[])


def seeds_of(seed: int, name: str, iteration: int, numbers: Tensor) -> Tensor:
    return torch.tensor([stream_seed(seed, f"moving_disc_{name}", iteration, int(n)) % MAX_SEED for n in numbers])


def select(scenes: Scenes, index: Tensor) -> Scenes:
    return Scenes(scenes.background[index], scenes.start[index], scenes.speed[index], scenes.action[index])


def _shape(scenes: Scenes) -> tuple[int, int, int, int]:
    return CHANNELS, FRAMES, scenes.side, scenes.side


def _means(scores: Scores, prefix: str = "") -> dict[str, float]:
    names = ("reward", "task", "mass", "background", "obeyed", "consistency")
    return {prefix + name: float(getattr(scores, name).mean()) for name in names}


def group_spread(buffer: RolloutBuffer, group_size: int) -> dict[str, float]:
    """How far the videos of a scene spread while an arm trains, mean over the buffer's scenes.

    rollout_diversity: DD-19 of centred pixels. rollout_reward_std: of the training reward.
    """
    latents = buffer.rollout.latents
    groups = latents.view(-1, group_size, *latents.shape[1:])
    stds = buffer.rewards["total"].view(-1, group_size).std(1, correction=0)
    diversity = sum(rollout_diversity(centred_pixels(videos)) for videos in groups) / len(groups)
    return {"rollout_diversity": diversity, "rollout_reward_std": float(stds.mean())}


def _largest_advantage(buffer: RolloutBuffer) -> float:
    """The largest |A| of DD-13 before it is clipped."""
    unclipped = group_advantages(buffer.rewards["total"], buffer.group_ids, buffer.valid, clip=math.inf)
    return float(unclipped.advantages_N.abs().max())
