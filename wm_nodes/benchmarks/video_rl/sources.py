"""What samplers are compared on, behind one interface: scenes of the moving disc, or contexts of recorded episodes.

Shapes: N videos of one buffer, in groups of one context each.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from benchmarks.video_rl.samplers import DiscPlan, LearningPlan, SamplerSetup
from benchmarks.video_rl.spread import group_spread
from wm_nodes.config.load import load_config, load_video_config
from wm_nodes.config.seed_ranges import SeedRange
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.video_model import RolloutBuffer, VideoNetwork
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.group_advantages import group_advantages
from wm_nodes.video_rl.sampling import RecordedContexts
from wm_nodes.video_rl.toy_scene import SceneRequest, Scenes, ToyContexts, draw_scenes
from wm_nodes.video_rl.train import ClipSource, Request
from wm_nodes.video_rl.validation import context_scores
from wm_nodes.world_model.position_probe import PositionProbe

TASK = "push_cube"
EPISODES = Path("runs/clip_contexts")
REWARDS = {"tracking": 1.0, "object_cm": -0.1}
"""Of recorded contexts."""


class TrainingSource(ClipSource[Request], Protocol[Request]):
    """A source of clips that can say what a training made of its video model."""

    @property
    def network(self) -> VideoNetwork: ...

    def measure(self, buffer: RolloutBuffer) -> Mapping[str, float]:
        """Numbers of a buffer beside those of the learner's report."""
        ...

    def validate(self) -> Mapping[str, list[float]]:
        """The scores of each held-out context, one video by ODE, by the network's weights of now."""
        ...


class DiscSource(ToyContexts):
    """Scenes of the moving disc, drawn anew for every buffer."""

    def __init__(self, network: VideoNetwork, sampler: SamplerSetup, plan: DiscPlan, seed: int) -> None:
        super().__init__(network, config_of(sampler, plan, seed), side=plan.side, reward=plan.proxy)
        self._heldout = draw_scenes(plan.eval_contexts, seed, "evaluation", side=plan.eval_side)

    def measure(self, buffer: RolloutBuffer) -> dict[str, float]:
        """group_spread, and the largest |A| of DD-13 before it is clipped."""
        unclipped = group_advantages(buffer.rewards["total"], buffer.group_ids, clip=math.inf)
        largest = float(unclipped.advantages_N.abs().max())
        return {**group_spread(buffer, self.config.groups.group_size), "advantage_max": largest}

    def validate(self) -> dict[str, list[float]]:
        return {name: values.tolist() for name, values in self.evaluate(self._heldout).items()}


class RecordedSource(RecordedContexts):
    """Contexts of recorded episodes; `heldout` are others."""

    def __init__(
        self, folder: VideoFolder, contexts: Clips, heldout: Clips, probe: PositionProbe, config: VideoRlConfig
    ) -> None:
        super().__init__(folder, contexts, config, probe)
        self.network, self._heldout = folder.network, heldout

    def measure(self, buffer: RolloutBuffer) -> dict[str, float]:
        return {}

    def validate(self) -> Mapping[str, list[float]]:
        found = context_scores(self.folder, self._heldout, self.probe, self.config)
        return {name: values.tolist() for name, values in found.items()}


def config_of(
    sampler: SamplerSetup, plan: LearningPlan, seed: int, preset: str = "base", rewards: Mapping[str, float] = REWARDS
) -> VideoRlConfig:
    """The settings of loop 2 that a sampler and a plan stand for; held-out videos take the sampler's own steps."""
    base = load_video_config(preset, {"task": TASK, "rewards": dict(rewards)})
    groups = base.groups.with_values(
        contexts=plan.contexts, group_size=plan.group_size, shared_noise=sampler.shared_noise
    )
    return base.with_values(
        seed=seed, groups=groups, window=sampler.window, grpo=sampler.grpo,
        rollout=sampler.rollout,
        evaluation=base.evaluation.with_values(contexts=plan.eval_contexts, num_steps=sampler.rollout.num_steps),
    )


def recorded_episodes(
    clips: int, seeds: SeedRange, task: str = TASK, changes: Mapping[str, Any] | None = None
) -> list[Path]:
    """Bags of scripted episodes, a tenth more than the clips that are wanted: one that ends early gives none.

    changes: of the simulator's settings.
    """
    scene = load_config("cpu", {"task": task, **(changes or {})})
    plan = scripted_plan(scene, math.ceil(1.1 * clips), seeds)
    suffix = "".join(f"_{value}" for value in (changes or {}).values())
    return collect_plan(plan, scene, EPISODES / f"{task}_{plan.first_seed}_{plan.num_episodes}{suffix}")


def sample_scenes(
    network: VideoNetwork, sampler: SamplerSetup, scenes: Scenes, group_size: int, seed: int, iteration: int = 0
) -> RolloutBuffer:
    """Sample group_size videos of every scene and score them."""
    plan = LearningPlan(contexts=len(scenes), group_size=group_size)
    source, request = ToyContexts(network, config_of(sampler, plan, seed)), SceneRequest(scenes, iteration, 0)
    return source.score(request, source.sample(request))
