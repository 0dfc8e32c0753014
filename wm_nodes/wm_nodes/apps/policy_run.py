"""One training in the world model as a ROS graph: its folder, what is measured in it, and what a resume finds there.

Whatever took long is kept as a file with the identity of what it was measured on, so that a run that is started again
goes on where it stopped, and never takes a trained policy for the one it began with.
"""

import json
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.config.environments import NO_ENVIRONMENT
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.files import file_sha256, write_atomic
from wm_nodes.core.model_folder import AGAIN, files_sha256, read_json
from wm_nodes.core.progress import tqdm
from wm_nodes.core.statistics import wilson_interval
from wm_nodes.core.types import BoolArray
from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching.graph_client import GraphClient
from wm_nodes.launching.runner import Runner
from wm_nodes.policy_rl.factories import load_policy, make_imagined_environment, make_video_environment, models_of
from wm_nodes.policy_rl.initial_policy import num_starts
from wm_nodes.policy_rl.training_run import POLICY_FILES
from wm_nodes.policy_rl.validation.evaluation import evaluate
from wm_nodes.reports.stages import Stages
from wm_nodes.reports.summary import SuccessRate
from wm_nodes.training.checkpoint import RESTORE
from wm_nodes.training.run_record import keep_config
from wm_nodes.video_model.folder import read_video_manifest

READY_S = 120.0
TRAINED = "trained.json"

@dataclass(frozen=True)
class RunContext:
    """What all trainings of a run share."""

    config: RunConfig
    """The run's settings."""
    run_dir: Path
    """The run folder."""
    starts: Path
    """First frames to imagine from."""
    stage: Stages
    """Prints which stage the run is in."""
    domain_id: str = ""
    """ROS domain; empty: $ROS_DOMAIN_ID, else 0."""
    compose: bool = False
    """All nodes in one process."""
    verbose: bool = False
    """Show the nodes' logs."""
    reward: str = "endogenous"
    """As the launch argument."""
    video_model: str = ""
    """Folder of the video model to train in; empty: the world model."""
    view: Mapping[str, str] = field(default_factory=dict)
    """The launch arguments of the live page; none: no page."""

    @property
    def measures(self) -> bool:
        """Whether policies are measured in an environment, and not only in the model."""
        return self.config.evaluation.environment != NO_ENVIRONMENT

    @property
    def trained_in(self) -> str:
        return "video model" if self.video_model else "world model"

    @property
    def environment(self) -> dict[str, str]:
        """The launch arguments of what the policy is trained in."""
        return {"backend": "video_model", "video_model_dir": self.video_model} if self.video_model else {}


@dataclass(frozen=True)
class TrainingStart:
    """What one training begins with."""

    folder: Path
    """Its own run folder."""
    model_dir: Path
    """The world model to train in."""
    policy: Path
    """Weights that it starts from."""
    config: RunConfig
    """Settings of this training."""
    starts: Path
    """Frames to imagine from."""
    label: str = ""
    """For bags and messages, e.g. "round 2"."""


@dataclass(frozen=True)
class TrainingResult:
    """What one training gave."""

    version: int
    """Of the last weights."""
    updates: int
    """Updates made."""
    samples: int
    """Transitions trained on."""
    samples_per_s: float
    """Of the last uninterrupted part; NaN where that made no update."""
    bag: str
    """Recording of the training."""
    stopped: str = ""
    """Why training ended before all updates; else empty."""
    resumed: bool = False
    """Whether a call before made some of the updates, which `bag` then does not hold."""

    def policy(self, folder: Path) -> Path:
        return folder / POLICY_FILES.uri(self.version)


@dataclass(frozen=True)
class WaitingGraph:
    """A training's processes, started and not yet configured: they come up while what they will load is still made."""

    runner: Runner
    bag: Path


def start_graph(job: RunContext, start: TrainingStart) -> WaitingGraph:
    """Start the processes of one training; the caller stops the runner."""
    keep_config(start.config, start.folder)
    name = "_".join(["training", *start.label.split(), time.strftime("%H%M%S")])
    bag = job.run_dir / "bags" / name
    graph, _ = launch_arguments.prepare("online_training", {
        "reward": job.reward, "run_dir": str(start.folder),
        "model_dir": str(start.model_dir), "starts_file": str(start.starts), "first_frames_file": str(job.starts),
        "initial_policy": str(start.policy), "bag_uri": str(bag), "domain_id": job.domain_id,
        "compose": "true" if job.compose else "false", "autostart": "false", **job.environment, **job.view,
    })
    job.stage("starting the graph: " + ", ".join(node.label for node in graph.nodes))
    runner = Runner(graph, log_dir=start.folder / "logs", log=sys.stdout if job.verbose else None)
    runner.start()
    return WaitingGraph(runner, bag)


def is_trained(start: TrainingStart) -> bool:
    """Whether the training is made and, where policies are measured in an environment, its policy is."""
    measures = start.config.evaluation.environment != NO_ENVIRONMENT
    measured = not measures or _evaluation(start.folder, "real_after").is_file()
    return measured and (start.folder / TRAINED).is_file()


def train_round(
    job: RunContext, start: TrainingStart, judge: Callable[[BoolArray | None], None] | None = None,
    waiting: WaitingGraph | None = None,
) -> TrainingResult:
    """Train start.policy in start.model_dir and measure it in evaluation.environment; finished parts are kept.

    judge: called with the starting policy's real success (None: not measured) before any update; may raise to refuse
        the training.
    waiting: this training's processes, where they run already; stopped at the end.
    """
    marker = start.folder / TRAINED
    trained = TrainingResult(**read_json(marker, AGAIN)) if marker.is_file() else None
    if trained is not None:
        job.stage(f"{start.label or 'training'} is done already ({marker})")
        if is_trained(start):
            return trained
    waiting = waiting or start_graph(job, start)
    with closing(waiting.runner) as runner:
        runner.activate(READY_S)
        os.environ.update(runner.environment)
        with GraphClient(alive=runner.check) as operator:
            if trained is None:
                if judge is not None:
                    judge(_real(operator, job, start, "before", start.policy) if job.measures else None)
                trained = _make_updates(operator, job, start, str(waiting.bag))
                write_atomic(marker, json.dumps(asdict(trained), indent=1).encode())
            if job.measures:
                _real(operator, job, start, "after", trained.policy(start.folder))
    return trained


def _make_updates(operator: GraphClient, job: RunContext, start: TrainingStart, bag: str) -> TrainingResult:
    """Make the updates that are left."""
    before, began = _progress(start.folder), time.monotonic()
    remaining = max(0, start.config.ppo.updates - int(before["updates"]))
    job.stage(f"training the policy in the {job.trained_in}: {remaining} updates")
    stopped = _train(operator, remaining) if remaining else ""
    if stopped:
        job.stage(f"training ends: {stopped}")
    after, seconds = _progress(start.folder), time.monotonic() - began
    samples = int(after["samples"]) - int(before["samples"])
    version, updates, total = (int(after[name]) for name in ("version", "updates", "samples"))
    speed = samples / seconds if samples else math.nan
    return TrainingResult(version, updates, total, speed, bag, stopped, resumed=before["updates"] > 0)


def read_success(folder: Path, name: str) -> BoolArray:
    """A kept evaluation, (E,) in seed order. name: real_ or imagined_, then before or after."""
    values = read_json(_evaluation(folder, name), AGAIN)
    return np.asarray(values["success"], bool)


def _evaluation(folder: Path, name: str) -> Path:
    return folder / "evaluations" / f"{name}.json"


def imagined_success(job: RunContext, folder: Path, label: str, model_dir: Path, policy: Path) -> BoolArray:
    """Success in the model that is trained in, without action noise, on num_starts() episodes, each from another start,
    as far as there are as many, (E,)."""
    make = make_video_environment if job.video_model else make_imagined_environment
    model = Path(job.video_model or model_dir)
    sha256 = (
        files_sha256(read_video_manifest(model)) if job.video_model else models_of(model, job.config.device).sha256
    )

    def measure() -> BoolArray:
        env = make(job.config, model, job.starts, num_envs=64, seed=job.config.seed)
        weights = load_policy(job.config, model_dir, policy)
        episodes = min(num_starts(job.config), env.episodes.num_starts)
        return evaluate(weights, env, episodes, job.config.evaluation.first_seed).success

    identity = {"policy_sha256": file_sha256(policy), "model_sha256": sha256}
    success = cached_success(_evaluation(folder, f"imagined_{label}"), identity, measure)
    job.stage(f"imagined success of {policy.stem}: {int(success.sum())}/{len(success)}")
    return success


def cached_success(path: Path, identity: Mapping[str, str], measure: Callable[[], BoolArray]) -> BoolArray:
    """Success of episodes, (E,), from `path` when it was measured on the same things, else measured and written."""
    if path.is_file():
        values = read_json(path, AGAIN)
        if values["identity"] == dict(identity):
            return np.asarray(values["success"], bool)
    success = measure()
    rate = success_rate(success)
    content = {"identity": dict(identity), "success": success.astype(int).tolist(), "low": rate.low, "high": rate.high}
    write_atomic(path, json.dumps(content).encode())
    return success


def measured_rate(success: BoolArray | None) -> SuccessRate | None:
    """None for what was not measured."""
    return None if success is None else success_rate(success)


def success_rate(success: BoolArray) -> SuccessRate:
    low, high = wilson_interval(int(success.sum()), len(success))
    return SuccessRate(int(success.sum()), len(success), low, high)


def _real(operator: GraphClient, job: RunContext, start: TrainingStart, label: str, policy: Path) -> BoolArray:
    """Success of a weights file in the simulator, on the seeds of the configuration."""
    settings = job.config.evaluation

    def measure() -> BoolArray:
        with tqdm(total=settings.episodes, desc=f"real episodes {label}", unit="episode", leave=False) as bar:

            def show(done: int, share: float) -> None:
                bar.update(done - bar.n)
                bar.set_postfix(success=f"{share:.2f}")

            return operator.evaluate(
                episodes=settings.episodes, seed=settings.first_seed, deterministic=settings.deterministic,
                label=label, policy_uri=str(policy), on_progress=show,
            )

    identity = {"policy_sha256": file_sha256(policy)}
    success = cached_success(_evaluation(start.folder, f"real_{label}"), identity, measure)
    found = success_rate(success)
    job.stage(
        f"real success {label} training: {found.successes}/{found.episodes} (95 % {found.low:.2f} to {found.high:.2f})"
    )
    return success


def _train(operator: GraphClient, updates: int) -> str:
    """Make the updates; return why fewer were made, or ""."""
    with tqdm(total=updates, desc="PPO in the model", unit="update") as bar:

        def show(feedback: Any) -> None:
            bar.update(feedback.update - bar.n)
            bar.set_postfix(imagined_success=f"{feedback.success_rate:.2f}", mean_return=f"{feedback.mean_return:.2f}")

        result = operator.train(updates, show)
        if not result.message:
            bar.update(updates - bar.n)
    return str(result.message)


def _progress(folder: Path) -> dict[str, Any]:
    """Counts of the learner's newest checkpoint, which is on disk before its version is announced."""
    progress: dict[str, Any] = read_json(folder / "checkpoints" / "learner.json", RESTORE)["progress"]
    return progress
