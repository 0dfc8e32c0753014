"""Policies trained in a model and measured in the simulator, and how a model ranks policies.

A model is the task's world model, or a video model that can be stepped, given by its folder.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from hashlib import sha256
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wm_nodes.config.object_state import with_reader
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.files import file_sha256
from wm_nodes.core.model_folder import files_sha256
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.statistics import paired_difference, t_interval, wilson_interval
from wm_nodes.core.types import Environment
from wm_nodes.environments.registry import make_environment
from wm_nodes.policy_rl.device_rollout import unseen_pictures_left_out
from wm_nodes.policy_rl.factories import (
    load_policy,
    make_imagined_environment,
    make_reward,
    make_video_environment,
)
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.initial_policy import num_starts, prepare_start
from wm_nodes.policy_rl.model_refresh import Round, refresh_round, run_rounds, split_updates
from wm_nodes.policy_rl.rollouts import rollout_statistics
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.policy_rl.validation.acceptance import accept_model
from wm_nodes.policy_rl.validation.evaluation import EvaluationResult, evaluate
from wm_nodes.policy_rl.validation.exploit_meter import ExploitMeter, make_exploit_meter
from wm_nodes.reward import RewardModel
from wm_nodes.training.weights import save_weights
from wm_nodes.video_model.folder import read_video_manifest
from wm_nodes.world_model import ImaginedEpisodes
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.validation.acceptance_report import AcceptanceReport

WORLD_MODEL, SIMULATOR = "world_model", "simulator"
SIMULATOR_ENVS = 8
KEPT_EVERY = 6
"""Updates between two versions of a training that are kept to be ranked."""


@dataclass(frozen=True)
class Workplace:
    """One seed of the main job."""

    config: RunConfig
    """Its seed is that of the job."""
    model_dir: Path
    """The task's world model."""
    folder: Path
    """Of its starts and of the policy that training begins with; made there once."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "config", with_reader(self.config, self.model_dir))

    @cached_property
    def start(self) -> tuple[Path, Path]:
        """First frames and weak policy, see prepare_start."""
        return prepare_start(self.config, self.folder, self.model_dir)

    def policy(self, weights: Path | None = None) -> ImagePolicy:
        """The policy of a file; None: the one that training begins with."""
        return load_policy(self.config, self.model_dir, weights or self.start[1])

    def environment(self, model: str, num_envs: int = 0) -> ImaginedEpisodes:
        """model: WORLD_MODEL, or a video model's folder. num_envs: 0 for the configuration's."""
        make = make_imagined_environment if model == WORLD_MODEL else make_video_environment
        folder = self.model_dir if model == WORLD_MODEL else Path(model)
        count = num_envs or self.config.ppo.num_envs
        return make(self.config, folder, self.start[0], num_envs=count, seed=self.config.seed)

    @property
    def rounds(self) -> Path:
        """Folder of the rounds by these settings in this model: others refresh it on episodes of another policy."""
        made_of = json.dumps(self.identity(WORLD_MODEL), sort_keys=True)
        return self.folder / f"rounds_{sha256(made_of.encode()).hexdigest()[:8]}"

    @contextmanager
    def simulator(self, scenes: str = "", num_envs: int = SIMULATOR_ENVS) -> Iterator[Environment]:
        """The environment that policies are measured in. scenes: others than the configuration's."""
        config = self.config
        simulation = config.simulation.with_values(scenes=scenes or config.simulation.scenes)
        there, name = config.with_values(simulation=simulation), config.evaluation.environment
        with closing(make_environment(there, name, num_envs=num_envs, seed=config.seed)) as env:
            yield env

    def real(self, policy: ImagePolicy, scenes: str = "") -> EvaluationResult:
        """Success in the simulator, on the seeds of the configuration. scenes: others than the configuration's."""
        how = self.config.evaluation
        with self.simulator(scenes, min(SIMULATOR_ENVS, how.episodes)) as env:
            return evaluate(policy, env, how.episodes, how.first_seed, how.deterministic)

    def acceptance(
        self, model: str, policy: ImagePolicy, imagined: EvaluationResult, real: EvaluationResult
    ) -> AcceptanceReport:
        """Whether the policy may be trained in the model, which it has this success in and in the simulator."""
        return accept_model(
            self.config, self.model_dir, policy, (imagined.successes, imagined.episodes),
            (real.successes, real.episodes), self.folder / "bags" / "heldout",
            video_model_dir=None if model == WORLD_MODEL else Path(model),
        )

    def identity(self, model: str, scenes: Sequence[str] = ()) -> dict[str, Any]:
        """What a row of train_in is known by: every setting, and the models' weights."""
        shas = [] if model in (WORLD_MODEL, SIMULATOR) else [files_sha256(read_video_manifest(Path(model)))]
        return {
            "model": model, "config": self.config.model_dump(mode="json"), "scenes": list(scenes),
            "models_sha256": [files_sha256(read_world_manifest(self.model_dir)), *shas],
        }

    def imagined(self, policy: ImagePolicy, env: ImaginedEpisodes) -> EvaluationResult:
        """Of episodes of which each begins at another start."""
        with unseen_pictures_left_out(env, policy):
            episodes = min(num_starts(self.config), env.episodes.num_starts)
            return evaluate(policy, env, episodes, self.config.evaluation.first_seed)


def train_in(
    workplace: Workplace, model: str, scenes: Sequence[str] = (), on_update: Callable[[], object] = lambda: None
) -> dict[str, Any]:
    """Train the weak policy of a seed in a model, whatever acceptance says of it; return the row of the table. In the
    world model, by all settings of model_refresh and exploit_meter.

    Every KEPT_EVERY-th version lies in workplace.folder / name of the model.

    Args:
        model: as for Workplace.environment, or SIMULATOR, where success alone pays; that row's imagined success is
            in the world model.
        scenes: further ones that the policies are measured in, values of simulation.scenes.
    """
    config, began = workplace.config, time.monotonic()
    policy, env = workplace.policy(), workplace.environment(WORLD_MODEL if model == SIMULATOR else model)
    before = workplace.real(policy), workplace.imagined(policy, env)
    accepted = None if model == SIMULATOR else workplace.acceptance(model, policy, before[1], before[0])
    elsewhere = {name: [workplace.real(policy, name)] for name in scenes}
    course, kept, seconds = list[float](), list[str](), time.monotonic()

    def note(success_rate: float) -> None:
        course.append(success_rate)
        update = len(course)
        if update % KEPT_EVERY == 0 or update == config.ppo.updates:
            path = workplace.folder / Path(model).name / f"policy_{update:06d}.safetensors"
            save_weights(policy, path, {"tokenizer_sha256": policy.encoder.sha256})
            kept.append(str(path))
        on_update()

    rounds = Rounds(workplace.model_dir)
    if model == WORLD_MODEL:
        rounds = _train_in_rounds(workplace, policy, note)
        env = replace(workplace, model_dir=rounds.model_dir).environment(model)
    else:
        for success_rate in train_on(workplace, policy, None if model == SIMULATOR else env):
            note(success_rate)
    seconds = time.monotonic() - seconds
    after = workplace.real(policy), workplace.imagined(policy, env)
    for name, measured in elsewhere.items():
        measured.append(workplace.real(policy, name))
    return {
        **workplace.identity(model, scenes), "accepted": None if accepted is None else accepted.passed,
        "acceptance": {} if accepted is None else accepted.to_dict(),
        "model_sha256": env.spec.world_model_sha256, "task": config.task, "seed": config.seed,
        "updates": config.ppo.updates, "advantage": config.ppo.advantage, "course": course, "policies": kept,
        "real_before": rate_of(before[0]), "real_after": rate_of(after[0]),
        "imagined_before": rate_of(before[1]), "imagined_after": rate_of(after[1]),
        "real_gain": _gain(before[0], after[0]),
        "elsewhere": {
            name: {"before": rate_of(first), "after": rate_of(last), "gain": _gain(first, last)}
            for name, (first, last) in elsewhere.items()
        },
        "success_before": before[0].success.astype(int).tolist(),
        "success_after": after[0].success.astype(int).tolist(),
        "exploit_meter": rounds.readings, "refreshes": rounds.refreshes,
        "seconds_per_update": seconds / max(1, len(course)), "minutes": (time.monotonic() - began) / 60,
    }


def train_on(
    workplace: Workplace, policy: ImagePolicy, imagined: Environment | None, scenes: str = ""
) -> Iterator[float]:
    """Train in place; the success rate of each update's rollout.

    imagined: None: the simulator, where success alone pays. scenes: of the simulator, others than the configuration's.
    """
    config = workplace.config
    if imagined is None:
        with workplace.simulator(scenes) as env:
            yield from _success_rates(policy, env, make_reward(config, None), config)
    else:
        yield from _success_rates(policy, imagined, make_reward(config, workplace.model_dir, golden=True), config)


def _success_rates(
    policy: ImagePolicy, env: Environment, reward: RewardModel, config: RunConfig, meter: ExploitMeter | None = None
) -> Iterator[float]:
    for rollout, _ in train_policy(policy, env, reward, config, meter):
        yield rollout_statistics(rollout).success_rate


@dataclass
class Rounds:
    """What a training in the world model gave, beside the policy and its course."""

    model_dir: Path
    """The model that it ended in."""
    readings: list[dict[str, float]] = field(default_factory=list)
    """Rows of the exploit meter."""
    refreshes: list[dict[str, Any]] = field(default_factory=list)
    """The decision on each refreshed model."""


def _train_in_rounds(workplace: Workplace, policy: ImagePolicy, note: Callable[[float], None]) -> Rounds:
    """Train in place. note: gets the success rate of each update's rollout."""
    config, first_frames, rounds = workplace.config, workplace.start[0], Rounds(workplace.model_dir)

    def train(part: Round) -> bool:
        env = make_imagined_environment(
            part.config, part.model_dir, part.starts, num_envs=config.ppo.num_envs, seed=part.config.seed, training=True
        )
        meter = make_exploit_meter(part.config, part.model_dir, first_frames, simulator)
        reward = make_reward(part.config, part.model_dir, golden=True)
        for success_rate in _success_rates(policy, env, reward, part.config, meter):
            note(success_rate)
        made = sum(split_updates(config.ppo.updates, config.model_refresh.num_rounds)[: part.number - 1])
        rounds.readings += [] if meter is None else [{**row, "update": row["update"] + made} for row in meter.rows()]
        rounds.model_dir = part.model_dir
        if part.last:
            return False
        weights = part.folder / "policy.safetensors"
        weights.parent.mkdir(parents=True, exist_ok=True)
        save_weights(policy, weights, {"tokenizer_sha256": policy.encoder.sha256})
        decision = refresh_round(config, part.model_dir, weights, first_frames, workplace.rounds, part.number)
        rounds.refreshes.append(decision.to_dict())
        return decision.accepted

    with ExitStack() as stack:
        @cache
        def simulator() -> Environment:
            return stack.enter_context(workplace.simulator())

        run_rounds(config, workplace.rounds, workplace.model_dir, first_frames, train)
    return rounds


def known_policy(workplace: Workplace, weights: Path, models: Sequence[str]) -> dict[str, Any]:
    """What a row of the ranking is known by: every setting, the policy, and the models."""
    return {
        "policy": str(weights), "sha256": file_sha256(weights), "config": workplace.config.model_dump(mode="json"),
        "models_sha256": {model: workplace.identity(model)["models_sha256"] for model in models},
    }


def measure_policy(workplace: Workplace, weights: Path, models: Sequence[str]) -> dict[str, Any]:
    """Success of a policy in the simulator and in each model, its row of the ranking."""
    policy = workplace.policy(weights)
    imagined = {model: rate_of(workplace.imagined(policy, workplace.environment(model))) for model in models}
    known = known_policy(workplace, weights, models)
    return {**known, "real": rate_of(workplace.real(policy)), "imagined": imagined}


def rank_policies(rows: Sequence[dict[str, Any]], models: Sequence[str], seed: int) -> dict[str, dict[str, float]]:
    """For each model: the Spearman correlation of imagined with real success over the policies, and its interval."""
    real = [row["real"]["rate"] for row in rows]
    found = {model: spearman(real, [row["imagined"][model]["rate"] for row in rows], seed=seed) for model in models}
    return {model: dict(zip(("correlation", "low", "high"), values, strict=True)) for model, values in found.items()}


def spearman(x: ArrayLike, y: ArrayLike, *, seed: int, draws: int = 10_000) -> tuple[float, float, float]:
    """Return Spearman's rank correlation, ties by their mean rank, and its 95 % percentile bootstrap interval over the
    pairs; draws without spread are left out, and NaN is where there is none.

    Raises:
        ValueError: lengths differ.
    """
    first, second = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if first.shape != second.shape or first.ndim != 1:
        raise ValueError(f"a correlation needs pairs, got {first.shape} and {second.shape}")
    rng = numpy_stream(seed, "spearman", len(first))
    index = rng.integers(len(first), size=(draws, len(first)))
    drawn = np.array([_correlation(first[rows], second[rows]) for rows in index])
    drawn = drawn[np.isfinite(drawn)]
    low, high = np.quantile(drawn, (0.025, 0.975)) if len(drawn) else (np.nan, np.nan)
    return _correlation(first, second), float(low), float(high)


def _correlation(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    if (x == x[0]).all() or (y == y[0]).all():
        return float("nan")
    return float(np.corrcoef(_ranks(x), _ranks(y))[0, 1])


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    _, index, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: NDArray[np.float64] = (np.cumsum(counts) - (counts - 1) / 2)[index]
    return ranks


def _gain(before: EvaluationResult, after: EvaluationResult) -> dict[str, float]:
    pair = paired_difference(before.success.tolist(), after.success.tolist())
    return {"difference": pair.difference, "low": pair.low, "high": pair.high}


def rate_of(result: EvaluationResult) -> dict[str, float]:
    low, high = wilson_interval(result.successes, result.episodes)
    return {"rate": result.success_rate, "successes": result.successes, "episodes": result.episodes, "low": low,
            "high": high}


def rate_over_seeds(rates: Sequence[float]) -> str:
    """Mean of percentages, with its t interval (inside 0 to 100) where there are several; "-" for NaN."""
    text = f"{fmean(rates):.1f}".replace("nan", "-")
    if len(rates) == 1 or text == "-":
        return text
    over = t_interval(rates)
    return f"{text} ({max(0.0, over.low):.1f} to {min(100.0, over.high):.1f})"


def mean_gain(rates: Mapping[tuple[str, str, str], float], training: str, baseline: str) -> float:
    """Mean over policies and tasks of rate(training) - rate(baseline), in the unit of the rates, as RoboScape-R reports
    it. rates: a success rate for each policy, training and task.

    Raises:
        ValueError: a cell that only one of the two trainings has, or none at all.
    """
    names = {name: {(policy, task) for policy, other, task in rates if other == name} for name in (training, baseline)}
    alone = names[training] ^ names[baseline]
    if alone or not names[training]:
        raise ValueError(
            f"{training!r} and {baseline!r} have been measured on different cells: {sorted(alone) or 'none'}; "
            "leave out what has no fellow"
        )
    return fmean(rates[policy, training, task] - rates[policy, baseline, task] for policy, task in names[training])
