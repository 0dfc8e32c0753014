"""Closed loop: a video model that goes on from its own frames is post-trained on continuations of its own histories,
by group methods and by controls of the same compute (controls.py), and rolled out whole over held-out episodes.

Compute of a buffer, in forwards of one clip: contexts x history x steps for the histories, contexts x group_size x
steps for the groups, TRAINING_CALLS for each (clip, step) or (clip, time) that trains, and one more with NFT.
"""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from benchmarks.experiment import Count, console
from benchmarks.video_rl import tables
from benchmarks.video_rl.comparison import SamplerComparison
from benchmarks.video_rl.controls import TRAINING_CALLS, BestAndRecorded, FlowMatchingLearner, RecordedTargets
from benchmarks.video_rl.learning import train_sampler
from benchmarks.video_rl.samplers import LearningPlan, SamplerSetup, outcome_samplers
from benchmarks.video_rl.sources import TASK, RecordedSource, config_of
from benchmarks.video_rl.spread import reward_spread
from benchmarks.video_rl.trainings import OnIteration, RecordedTrainings, training_name
from benchmarks.video_rl.trials import SamplerTrial
from wm_nodes.config.seed_ranges import seed_spans
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder, save_video_folder
from wm_nodes.video_model.success_reader import SUCCESS_MANIFEST, WEIGHTS
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.horizons import horizon_scores
from wm_nodes.video_rl.reference_reward import load_probe, score_clips
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.world_model.position_probe import PositionProbe

PRESET, REWARDS = "closed_loop", {"tracking": 1.0}
BEST, RECORDINGS = "best of n and recordings", "recordings"
DRAWS, UPDATES = 4, {BEST: 3, RECORDINGS: 4}
"""Of the controls: (time, noise) pairs per recorded clip; optimizer steps per buffer, which share the pairs."""
MEASURES = ("error_cm", "error_cm_path", "win", "object_cm", "tool_cm", "psnr_db")
SCORES = ("tracking", "object_cm", "tool_cm", "psnr_db", "scenery")
SHOWN = ("error_cm", "win", "object_cm", "tool_cm", "psnr_db", "object_cm_4", "tool_cm_4")


@dataclass(frozen=True)
class ClosedLoopPlan(LearningPlan):
    """Held-out episodes are rolled out whole."""

    iterations: int = 30
    """Buffers."""
    contexts: int = 8
    """Of a buffer, 8 clips each."""
    eval_every: int = 10
    """Buffers."""
    history: int = 2
    """Clips at most before those of a group."""


def closed_loop_samplers() -> list[SamplerSetup]:
    """Group methods that train the same number of (clip, step) pairs (in a window of 2 of the 3 steps that can train,
    half as many clips again), and the two controls: flow matching on recordings, and on them and each group's best."""
    group = [_fill_window(one) if one.name.endswith("window") else one for one in outcome_samplers(PRESET)]
    controls = {name: group[0].grpo.with_values(updates_per_buffer=steps) for name, steps in UPDATES.items()}
    return [*group, *(replace(group[0], name=name, grpo=grpo) for name, grpo in controls.items())]


def calls_of_buffer(config: VideoRlConfig) -> dict[str, float]:
    """Return the mean forwards of one clip that a buffer of a group method costs, see above."""
    groups, grpo, steps = config.groups, config.grpo, config.rollout.num_steps
    kept = min(grpo.advantage.best_of_n or groups.group_size, groups.group_size)
    trained = steps - 1 if config.window.strategy == "all" else min(config.window.size, steps - 1)
    each = trained * TRAINING_CALLS if grpo.objective == "ratio" else grpo.nft.times * (TRAINING_CALLS + 1)
    return {
        "history": groups.contexts * groups.history / 2 * steps,
        "sampling": float(groups.contexts * groups.group_size * steps),
        "training": float(groups.contexts * kept * each),
    }


def equal_compute(config: VideoRlConfig, control: str) -> tuple[int, int]:
    """Return contexts per buffer and (time, noise) pairs per clip that cost a control what a group method costs."""
    calls, contexts = calls_of_buffer(config), config.groups.contexts
    if control == BEST:
        pairs = calls["training"] / (TRAINING_CALLS * 2 * contexts)  # on the best clip, and on the recording
        return contexts, max(1, round(pairs / UPDATES[BEST])) * UPDATES[BEST]
    each = calls["history"] / contexts + TRAINING_CALLS * DRAWS
    return round(sum(calls.values()) / each), DRAWS


class ClosedLoopSource(RecordedSource):
    """Continuations of the model's own histories; held-out contexts are rolled out whole, clip after clip."""

    _before: torch.Tensor | None = None

    def measure(self, buffer: RolloutBuffer) -> dict[str, float]:
        return {"reward_spread": reward_spread(buffer)}

    def validate(self) -> Mapping[str, list[float]]:
        """Scores of whole rollouts and of each of their clips. error_cm: of tool and object together. win: 1 where that
        is smaller than at the first call, 0.5 where it is the same."""
        frames = sample_by_ode(self.folder, self._heldout, self.config, self.config.evaluation.num_steps)
        found = score_clips(frames, self._heldout, self.probe, self.folder.clip["num_conditioning"])
        scores = {name: found[name] for name in SCORES}
        scores["error_cm"] = scores["object_cm"] + scores["tool_cm"]
        if self._before is None:
            self._before = scores["error_cm"]
        scores["win"] = (torch.sign(self._before - scores["error_cm"]) + 1) / 2
        scores |= horizon_scores(frames, self._heldout, self.probe, self.folder)
        return {name: values.tolist() for name, values in scores.items()}


class TargetSource(RecordedTargets, ClosedLoopSource):
    """Recordings in place of continuations, validated alike."""


class BestSource(BestAndRecorded, ClosedLoopSource):
    """Continuations with recordings among them, validated alike."""


def train_arm(
    folder: VideoFolder, contexts: Clips, heldout: Clips, probe: PositionProbe, sampler: SamplerSetup,
    plan: ClosedLoopPlan, seed: int, on_iteration: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Post-train folder.network in place; return train_sampler's row with learning_rate and calls per buffer."""
    config = config_of(sampler, plan, seed, PRESET, REWARDS)
    config = config.with_values(groups=config.groups.with_values(history=plan.history))
    learner: GrpoLearner | FlowMatchingLearner
    source: type[ClosedLoopSource] = ClosedLoopSource
    calls = sum(calls_of_buffer(config).values())
    if sampler.name in (BEST, RECORDINGS):
        count, draws = equal_compute(config, sampler.name)
        config = config.with_values(groups=config.groups.with_values(contexts=count))
        source = BestSource if sampler.name == BEST else TargetSource
        learner = FlowMatchingLearner(folder.network, sampler.grpo, sampler.rollout, seed=seed, draws=draws)
    else:
        learner = GrpoLearner(folder.network, sampler.grpo, sampler.rollout, seed=seed)
    made = source(folder, contexts, heldout, probe, config)
    row = train_sampler(made, sampler, plan, seed, on_iteration, learner)
    return {**row, "learning_rate": sampler.grpo.learning_rate, "calls": calls}


@dataclass(kw_only=True)
class ClosedLoop(RecordedTrainings[ClosedLoopPlan]):
    """A video model that goes on from its own frames, post-trained on continuations of its own histories, by group
    methods and by controls of the same compute."""

    video_model: Path = shipped_model(TASK) / "video_model_closed_loop"
    """Folder that training begins with."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """A training of each sampler for each."""
    iterations: Count = ClosedLoopPlan.iterations
    """Buffers of each training."""
    contexts: Count = ClosedLoopPlan.contexts
    """Of a buffer, 8 clips each."""
    eval_contexts: Count = ClosedLoopPlan.eval_contexts
    """Held-out episodes."""
    eval_every: Count = ClosedLoopPlan.eval_every
    """Buffers between two evaluations."""
    history: int = ClosedLoopPlan.history
    """Clips at most that the model makes before those of a group."""
    models: Path | None = None
    """Keep the trained models here, a folder each."""

    measures: ClassVar = MEASURES

    def trials(self) -> list[SamplerTrial[ClosedLoopPlan]]:
        plan = ClosedLoopPlan(
            self.iterations, self.contexts, eval_contexts=self.eval_contexts, eval_every=self.eval_every,
            history=self.history,
        )
        return [SamplerTrial(arm, plan) for arm in self.with_rate(closed_loop_samplers())]

    def train(self, trial: SamplerTrial[ClosedLoopPlan], seed: int, on_iteration: OnIteration) -> dict[str, Any]:
        folder = self.folder()
        contexts, heldout = self.recordings(folder, trial.plan.eval_contexts)
        probe = load_probe(shipped_model(TASK), self.where)
        row = train_arm(folder, contexts, heldout, probe, trial.sampler, trial.plan, seed, on_iteration)
        if self.models:
            path = self.models / training_name(trial.sampler.name, seed)
            _keep_model(path, folder, self.video_model, row, seed_spans(contexts.seeds))
        return row

    def pairs(self, rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
        """Every arm with each control, and with CPS."""
        names = sorted({row["sampler"] for row in rows})
        bases = ("CPS 0.4", BEST, RECORDINGS)
        return [(name, base) for base in bases for name in names if base in names and name != base]

    def show(self, rows: list[dict[str, Any]], comparisons: list[SamplerComparison]) -> None:
        shown = [name for name in SHOWN if name in rows[0]["evaluations"][0]]  # shorter rollouts have no fourth clip
        console.print(tables.gain_table(rows, shown), tables.comparison_table(comparisons))


def _keep_model(
    place: Path, folder: VideoFolder, base: Path, row: Mapping[str, Any], seeds: list[list[int]]
) -> None:
    """Save the trained model, with the success reader of its base, so that a policy can be trained in it.

    seeds: of the contexts that it was post-trained on.
    """
    kept = ("sampler", "seed", "plan", "learning_rate")
    story: dict[str, Any] = {"task": TASK, "base": folder.sha256, "post_training": {name: row[name] for name in kept}}
    story["post_training"]["training_seeds"] = seeds
    save_video_folder(place, folder.codec, folder.network, folder.clip, story)
    for name in (WEIGHTS, SUCCESS_MANIFEST):
        shutil.copyfile(base / name, place / name)


def _fill_window(sampler: SamplerSetup) -> SamplerSetup:
    """In a window of 2 of 3 steps half as many clips again are trained on."""
    advantage = sampler.grpo.advantage
    more = advantage.with_values(best_of_n=3 * advantage.best_of_n // 2)
    return replace(sampler, grpo=sampler.grpo.with_values(advantage=more))
