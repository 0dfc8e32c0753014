"""What every part of the benchmark shares: the model, the starts, actions, seeds, alternating blocks.

Every comparison is interleaved (A B A B ...), so that whatever else the machine does falls on both sides.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import get_task, model_tasks
from wm_nodes.core.action_spaces import TRANSLATION
from wm_nodes.core.seeding import numpy_stream, stream_seed
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Environment, FloatArray, UInt64Array
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.factories import models_of
from wm_nodes.world_model import load_starts, save_model_folder
from wm_nodes.world_model.dynamics import ActionModel
from wm_nodes.world_model.state_model import state_sizes
from wm_nodes.world_model.text import TextModel, vocabulary_of
from wm_nodes.world_model.tokenizer import Tokenizer

NUM_STARTS = 64
TOOL_DIM = len(TRANSLATION.units)
"""Of actions and states."""

T = TypeVar("T")


@dataclass(frozen=True)
class Effort:
    """How much is measured. Blocks are one episode long; a first one of each kind warms up and does not count."""

    overhead_blocks: int
    """Of the graph, and as many in one process."""
    growth_steps: int
    """Of the environment that costs nothing."""
    simulator_blocks: int
    """Of each simulator, and as many imagined ones."""
    stage_repeats: int
    """Of each stage."""


def prepare_model(config: RunConfig, folder: Path, given: Path | None) -> tuple[Path, Path, str]:
    """Model folder, starts file and a description: the given one, the shipped one, or one of the configuration's size
    with random weights, which cost the same."""
    model_dir = given
    if model_dir is None:
        try:
            model_dir = shipped_model(config.task)
        except FileNotFoundError:
            model_dir = random_model(config, folder / "model")
    shipped = model_dir / "starts.safetensors"
    starts_file = folder / "starts.safetensors"
    if shipped.is_file():
        images, states = (array[:NUM_STARTS] for array in load_starts(shipped, config.task))
    else:
        rng = numpy_stream(config.seed, "benchmark_starts")
        size = config.simulation.image_size
        images = rng.integers(0, 256, (NUM_STARTS, size, size * len(config.simulation.cameras), 3), np.uint8)
        low, high = config.simulation.workspace_low_m, config.simulation.workspace_high_m
        states = np.zeros((NUM_STARTS, configured_spec(config).state_dim), np.float32)
        states[:, :3] = rng.uniform(low, high, (NUM_STARTS, 3))
    save_file({"images": torch.from_numpy(images.copy()), "states": torch.from_numpy(states.copy())}, starts_file)
    models = models_of(model_dir)
    millions = sum(p.numel() for m in (models.tokenizer, models.action) for p in m.parameters()) / 1e6
    kind = "random weights" if model_dir == folder / "model" else str(model_dir)
    text = "" if models.text is not None else ", no text model (no dense reward)"
    return model_dir, starts_file, f"{kind}, {millions:.2f} M parameters (tokenizer and action model){text}"


def random_model(config: RunConfig, folder: Path) -> Path:
    """A model folder of the configuration's size, untrained."""
    torch.manual_seed(stream_seed(config.seed, "benchmark_model") % 2**31)
    size, tasks = config.simulation.image_size, model_tasks(config.task)
    tokenizer = Tokenizer(config.tokenizer, size, size * len(config.simulation.cameras))
    sizes: dict[str, Any] = {
        "num_tokens": tokenizer.num_tokens, "latent_dim": tokenizer.latent_dim, "num_tasks": len(tasks),
    }
    spec = configured_spec(config)
    action = ActionModel(
        config.world_model, action_dim=spec.action_dim, state_dim=spec.state_dim, **sizes, **state_sizes(spec)
    )
    words = vocabulary_of(tuple(get_task(task).instruction for task in tasks))
    text = TextModel(config.world_model, vocabulary=words, **sizes)
    return save_model_folder(
        folder, tokenizer, action, text, config, spec=spec, tasks=tasks,
        story={"data": "none: random weights for benchmarks"},
    )


def interleave(contenders: Sequence[Callable[[int], T]], blocks: int) -> list[list[T]]:
    """Run A B A B ...; block 0 of each warms up and is dropped."""
    results_of: list[list[T]] = [[] for _ in contenders]
    for block in range(blocks + 1):
        for results, contender in zip(results_of, contenders, strict=True):
            results.append(contender(block))
    return [results[1:] for results in results_of]


def time_episode(env: Environment, block: int) -> NDArray[np.float64]:
    """Seconds of each step of one episode; the reset is not counted."""
    env.reset(None, seeds_of(env.spec, block))
    return _time_actions(env, actions_of(env.spec, block, env.spec.max_episode_steps))


def time_steps(env: Environment, steps: int) -> NDArray[np.float64]:
    env.reset(None, seeds_of(env.spec, 0))
    return _time_actions(env, actions_of(env.spec, 0, steps))


def _time_actions(env: Environment, actions: Iterator[FloatArray]) -> NDArray[np.float64]:
    seconds = []
    for action in actions:
        start = time.perf_counter()
        env.step(action)
        seconds.append(time.perf_counter() - start)
    return np.asarray(seconds)


def actions_of(spec: EnvironmentSpec, block: int, steps: int) -> Iterator[FloatArray]:
    rng = numpy_stream(block, "benchmark_actions")
    for _ in range(steps):
        yield rng.uniform(-1, 1, (spec.num_envs, spec.action_dim)).astype(np.float32)


def seeds_of(spec: EnvironmentSpec, block: int) -> UInt64Array:
    return (block * spec.num_envs + np.arange(spec.num_envs)).astype(np.uint64)
