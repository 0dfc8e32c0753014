"""Both loops on a device: imagined steps and training iterations, of several sizes of model."""

import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.device_suite import ModelSize, Plan, Point, Stopwatch
from benchmarks.speed.inputs import TOOL_DIM, prepare_model, random_model
from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import get_task, model_tasks
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.device_rollout import DeviceCollector, Step, capture_graph
from wm_nodes.policy_rl.factories import (
    make_device_environment,
    make_endogenous_reward,
    make_imagined_environment,
    make_policy,
    models_of,
)
from wm_nodes.policy_rl.rollouts import collect_rollout
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.loop import LossFunction, TrainingLoop
from wm_nodes.world_model.training.dynamics import train_action_model
from wm_nodes.world_model.training.latent_episodes import tokenise_episodes
from wm_nodes.world_model.training.tokenizer import train_tokenizer

EAGER, CAPTURED, HOST_LOOP = "eager", "captured", "loop over host arrays"
"""Ways to imagine."""
EPISODES = 64
"""Random ones, to train on."""
WARM_UP = 2
"""First iterations of a training, which do not count."""
ITERATION = "_step"
"""The method of TrainingLoop that makes one."""


@dataclass(frozen=True)
class Model:
    """A model that rollouts are made in."""

    config: RunConfig
    """On the device, with episodes that never terminate, so that every step counts."""
    folder: Path
    """Of the weights."""
    starts: Path
    """First frames."""


class Models:
    """Models by their size, made when first asked for. device: the setting. folder: of what is made."""

    def __init__(self, device: str, seed: int, folder: Path) -> None:
        self._device, self.seed, self._folder = device, seed, folder
        self._last = "", 0
        self._made: dict[tuple[str, int], Model] = {}

    def config(self, size: ModelSize, px: int, **changes: object) -> RunConfig:
        return load_config(size.preset, {
            "device": self._device, "seed": self.seed, "simulation.image_size": px, "reward.success_threshold": 1.0,
            "reward.dense_weight": 0.0, **changes,
        })

    def at(self, size: ModelSize, px: int) -> Model:
        """The shipped model where it has this size, else one with random weights."""
        if (size.name, px) != self._last:
            models_of.cache_clear()  # the memory of a point is that of its model
            self._last = size.name, px
        if (size.name, px) not in self._made:
            config, folder = self.config(size, px), self._folder / f"{size.name}_{px}"
            folder.mkdir()
            given = None if px == size.shipped_px else random_model(config, folder / "model")
            model_dir, starts, _ = prepare_model(config, folder, given)
            self._made[size.name, px] = Model(config, model_dir, starts)
        return self._made[size.name, px]


def imagination_points(plan: Plan, models: Models) -> Iterator[Point]:
    """Imagined steps/s with the sparse reward: rollouts that stay on the device, captured and eager, and the lock-step
    loop with pictures on the host."""

    def parameters(watch: Stopwatch, size: ModelSize, px: int) -> Mapping[str, float]:
        model = models.at(size, px)
        found = models_of(model.folder, model.config.device)
        return {"parameters_m": sum(p.numel() for m in (found.tokenizer, found.action) for p in m.parameters()) / 1e6}

    def rate(watch: Stopwatch, size: ModelSize, px: int, envs: int, way: str) -> list[float]:
        model = models.at(size, px)
        collect = (
            host_loop(model, envs) if way == HOST_LOOP else collector(model, envs, captured=way == CAPTURED).collect
        )
        work = partial(collect, plan.num_steps, models.seed, 1)
        return [plan.num_steps * envs / s for s in watch.repeats(work)]

    for size in plan.models:
        for px in size.sizes_px:
            at = {"model": size.name, "px": px}
            yield Point("models", at, "M parameters", partial(parameters, size=size, px=px))
            for envs, way in [
                *((envs, HOST_LOOP) for envs in plan.loop_envs),
                *((envs, way) for envs in plan.envs for way in ((EAGER, CAPTURED) if plan.captured else (EAGER,))),
            ]:
                measure = partial(rate, size=size, px=px, envs=envs, way=way)
                yield Point("imagination", {**at, "envs": envs, "way": way}, "steps/s", measure)


def host_loop(model: Model, envs: int) -> Callable[[int, int, int], Rollout]:
    """The lock-step loop, which has pictures on the host: (steps, seed, policy version) -> rollout."""
    config = model.config
    env = make_imagined_environment(config, model.folder, model.starts, num_envs=envs, seed=config.seed)
    policy, reward = make_policy(config, model.folder), make_endogenous_reward(config, model.folder)
    return partial(collect_rollout, env, policy, reward)


def collector(model: Model, envs: int, *, captured: bool) -> DeviceCollector:
    """What makes rollouts on the device, of the model's configuration.

    Raises:
        CaptureError: a lock-step could not be captured, where it should be.
        MemoryError: the device's memory did not suffice for it.
    """

    def capture(step: Step) -> Step:
        try:
            return capture_graph(env.device, step)
        except torch.OutOfMemoryError:
            raise MemoryError from None
        except RuntimeError as error:
            raise CaptureError(str(error)) from error

    config = model.config
    env = make_device_environment(config, model.folder, model.starts, num_envs=envs)
    policy, reward = make_policy(config, model.folder), make_endogenous_reward(config, model.folder)
    return DeviceCollector(env, policy, reward, capture=capture if captured else lambda step: step)


class CaptureError(Exception):
    """No RuntimeError, after which the collector would go on without a graph."""


def training_points(plan: Plan, models: Models) -> Iterator[Point]:
    """Milliseconds of a training iteration, of the tokenizer and of the action model with its longest rollouts, at
    shares of the preset's batch."""
    count = WARM_UP + plan.iterations

    def tokenizer(watch: Stopwatch, size: ModelSize, px: int, batch: int) -> list[float]:
        episodes = random_episodes(models.config(size, px), plan.num_steps)
        wanted = {"tokenizer.num_iterations": count, "tokenizer.batch_size": batch}
        with timed_iterations(watch) as seconds:
            train_tokenizer(episodes, models.config(size, px, **wanted), models.seed, None)
        return [1e3 * s for s in seconds[WARM_UP:]]

    def action_model(watch: Stopwatch, size: ModelSize, px: int, batch: int) -> list[float]:
        model = models.at(size, px)
        codec = models_of(model.folder, model.config.device).tokenizer
        data = tokenise_episodes(codec, random_episodes(model.config, plan.num_steps))
        wanted = {
            "world_model.num_iterations": count, "world_model.batch_size": batch,
            "world_model.rollout_steps": [plan.num_steps],
        }
        with timed_iterations(watch) as seconds:
            train_action_model(codec, data, models.config(size, px, **wanted), models.seed, None)
        return [1e3 * s for s in seconds[WARM_UP:]]

    for size in plan.trained:
        preset = load_config(size.preset)
        px = preset.simulation.image_size
        kinds = ("tokenizer", tokenizer, preset.tokenizer), ("action model", action_model, preset.world_model)
        for name, measure, settings in kinds:
            for batch in sorted({max(1, round(share * settings.batch_size)) for share in plan.batch_shares}):
                what = {"trained": name, "model": size.name, "px": px, "batch": batch}
                yield Point("training", what, "ms", partial(measure, size=size, px=px, batch=batch))


@contextmanager
def timed_iterations(watch: Stopwatch) -> Iterator[list[float]]:
    """Yield the seconds of each iteration that any TrainingLoop makes meanwhile, without its progress bar."""
    found: list[float] = []
    step = getattr(TrainingLoop, ITERATION)

    def timed(loop: TrainingLoop, loss: LossFunction) -> dict[str, Tensor]:
        terms: dict[str, Tensor] = {}
        found.append(watch.once(lambda: terms.update(step(loop, loss))))
        return terms

    setattr(TrainingLoop, ITERATION, timed)
    try:
        with redirect_stderr(io.StringIO()):
            yield found
    finally:
        setattr(TrainingLoop, ITERATION, step)


def random_episodes(config: RunConfig, steps: int) -> EpisodeArrays:
    """EPISODES episodes of noise: they cost what recorded ones cost."""
    rng, tasks = numpy_stream(config.seed, "benchmark_episodes"), model_tasks(config.task)
    size, frames = config.simulation.image_size, (EPISODES, steps + 1)
    numbers = len(get_task(config.task).ground_truth_names)
    return EpisodeArrays(
        images=rng.integers(0, 256, (*frames, size, size * len(config.simulation.cameras), 3), np.uint8),
        states=rng.uniform(0.3, 0.7, (*frames, TOOL_DIM)).astype(np.float32),
        actions=rng.uniform(-1, 1, (EPISODES, steps, TOOL_DIM)).astype(np.float32),
        ground_truth=rng.uniform(-0.3, 0.3, (*frames, numbers)).astype(np.float32),
        success=rng.random((*frames, len(tasks))) < 0.2, lengths=np.full(EPISODES, steps), tasks=tasks,
        instructions=("",) * EPISODES, behaviours=("random",) * EPISODES, recorded_tasks=(config.task,) * EPISODES,
    )
