"""Time and memory of one batch through each stage."""

import ctypes
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from benchmarks.experiment import console
from benchmarks.speed.inputs import Effort
from benchmarks.speed.simulator import IMAGINED_ENVS
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import UInt8Array
from wm_nodes.policy_rl.factories import make_endogenous_reward, make_policy, models_of
from wm_nodes.reward import RewardInput
from wm_nodes.world_model import load_starts
from wm_nodes.world_model.dynamics import done_signal
from wm_nodes.world_model.imagined_environment import CachedPart, cached_parts
from wm_nodes.world_model.parts import in_parallel
from wm_nodes.world_model.precision import compute_context


def measure_stages(config: RunConfig, effort: Effort, model: Path, starts: Path) -> dict[str, dict[str, float]]:
    """Milliseconds of one batch of 64 and the process's peak memory above its level before, by stage."""
    models = models_of(model)
    tokenizer, action = models.tokenizer, models.action
    rng = numpy_stream(config.seed, "benchmark_stages")
    images, states = (array[rng.integers(0, len(array), IMAGINED_ENVS)] for array in load_starts(starts))
    actions = rng.uniform(-1, 1, (IMAGINED_ENVS, models.spec.action_dim)).astype(np.float32)
    zeros = np.zeros(IMAGINED_ENVS, np.float32)
    sparse = config.model_copy(update={"reward": config.reward.model_copy(update={"dense_weight": 0.0})})
    dense = config.model_copy(update={"reward": config.reward.model_copy(update={"dense_weight": 1.0})})
    sparse_reward, dense_reward = make_endogenous_reward(sparse, model), make_endogenous_reward(dense, model)
    policy = make_policy(config, model)
    pictures = itertools.pairwise(fresh_pictures(images))

    def next_reward_input() -> RewardInput:
        """The next step of one rollout: the picture before is known from the last step, the one after is new."""
        before, after = next(pictures)
        return RewardInput(before, after, zeros, np.ones(IMAGINED_ENVS, bool), zeros, images)

    latents = tokenizer.encode(images)
    acted, before, after = (torch.from_numpy(array) for array in (actions, states, states))
    parts = cached_parts(action.trunk, IMAGINED_ENVS, latents.device)

    def advance(part: CachedPart) -> None:
        rows, caches = part
        with compute_context(latents.device):
            _, logits = action.advance(latents[rows], acted[rows], before[rows], after[rows], caches)
        done_signal(logits)

    def transition() -> None:
        in_parallel(advance, parts)

    for _ in range(config.world_model.window):
        transition()  # a full history is the longest
    stages: dict[str, Callable[[], object]] = {
        "encode": lambda: tokenizer.encode(images),
        "transition": transition,
        "decode": lambda: tokenizer.decode(latents),
        "reward, sparse": lambda: sparse_reward.evaluate(next_reward_input()),
        "reward, dense": lambda: dense_reward.evaluate(next_reward_input()),
        "policy": lambda: policy.act(images, states),
    }
    console.print("stages", highlight=False)
    return {name: measure_stage(work, effort.stage_repeats) for name, work in stages.items()}


def fresh_pictures(images: UInt8Array) -> Iterator[UInt8Array]:
    """Copies of images (N, H, W, 3) that differ in one pixel: nothing remembered about one helps with the next."""
    for number in itertools.count():
        images = images.copy()
        images[:, 0, 0, :2] = np.frombuffer(np.uint16(number).tobytes(), np.uint8)
        yield images


def measure_stage(work: Callable[[], object], repeats: int) -> dict[str, float]:
    work()
    before = restart_peak()
    work()
    peak = memory_mib("VmHWM")
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return {"ms": 1e3 * float(np.median(seconds)), "peak_mib": peak - before, "process_peak_mib": peak}


def restart_peak() -> float:
    """Give freed memory back, start the kernel's peak anew, and return the present level, MiB; NaN where it cannot."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    except (AttributeError, OSError):
        return float("nan")
    return memory_mib("VmRSS")


def memory_mib(name: str, file: str = "/proc/self/status") -> float:
    """A level of this process, e.g. VmRSS, or of another file of the kernel; NaN where there is none."""
    try:
        lines = Path(file).read_text(encoding="utf-8").splitlines()
    except OSError:
        return float("nan")
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:")), float("nan"))
