"""What bounds every program on a device: launches, products, copies, the host's share of a lock-step, the simulator."""

import os
from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.device_suite import Plan, Point, Stopwatch
from benchmarks.speed.inputs import NUM_STARTS, TOOL_DIM, interleave
from benchmarks.speed.simulator import rate_workers, simulator_kinds, simulator_workers
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import CPU
from wm_nodes.core.errors import RunError
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.device_rollout import rollout_starts
from wm_nodes.policy_rl.factories import models_of
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy, PolicyOutput
from wm_nodes.policy_rl.rollouts import action_noise, collect_rollout
from wm_nodes.reward import RuleReward
from wm_nodes.world_model import ImaginedEnvironment, WorldModels


def launch_points(plan: Plan) -> Iterator[Point]:
    """Microseconds of a tiny kernel in a long chain, each started by the host or all by one CUDA graph."""
    count = plan.kernels

    def chain(number: Tensor) -> None:
        for _ in range(count):
            number.add_(1)

    def eager(watch: Stopwatch) -> list[float]:
        number = torch.zeros(8, device=watch.device)
        return [1e6 * s / count for s in watch.repeats(lambda: chain(number))]

    def captured(watch: Stopwatch) -> list[float]:
        number, graph = torch.zeros(8, device=watch.device), torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            chain(number)
        return [1e6 * s / count for s in watch.repeats(graph.replay)]

    yield Point("launch", {"what": "a kernel, eager"}, "us", eager)
    if plan.captured:
        yield Point("launch", {"what": "a kernel, captured"}, "us", captured)


def ceiling_points(plan: Plan, device: str) -> Iterator[Point]:
    """Rates of matrix products and of copies; a copy on the device reads and writes each byte."""
    size, copied = plan.product_size, 2**20 * plan.copy_mib

    def product(watch: Stopwatch, dtype: torch.dtype) -> list[float]:
        a, b = (torch.randn(size, size, dtype=dtype, device=watch.device) for _ in range(2))
        return [2 * size**3 / s / 1e12 for s in watch.repeats(lambda: a @ b)]

    def copy(watch: Stopwatch) -> list[float]:
        source = torch.zeros(copied, dtype=torch.uint8, device=watch.device)
        target = torch.empty_like(source)
        return [2 * copied / s / 1e9 for s in watch.repeats(lambda: target.copy_(source))]

    def bus(watch: Stopwatch, up: bool, pinned: bool) -> list[float]:
        host = torch.zeros(copied // 8, dtype=torch.uint8)
        host, there = host.pin_memory() if pinned else host, host.to(watch.device)
        source, target = (host, there) if up else (there, host)
        return [copied / 8 / s / 1e9 for s in watch.repeats(lambda: target.copy_(source))]

    for dtype in (torch.bfloat16, torch.float32):
        yield Point("ceilings", {"what": f"matrix product, {str(dtype)[6:]}"}, "TFLOP/s", partial(product, dtype=dtype))
    yield Point("ceilings", {"what": "copy on the device"}, "GB/s", copy)
    if device != CPU:
        for up, pinned in ((True, True), (False, True), (True, False), (False, False)):
            name = f"copy {'up' if up else 'down'}, {'pinned' if pinned else 'ordinary'} memory"
            yield Point("ceilings", {"what": name}, "GB/s", partial(bus, up=up, pinned=pinned))


class FreeEnvironment(ImaginedEnvironment):
    """An imagined environment whose model costs nothing: what is left is the host's share of a lock-step."""

    def __init__(self, models: WorldModels, spec: EnvironmentSpec, config: RunConfig) -> None:
        rng = numpy_stream(config.seed, "benchmark_host")
        images = rng.integers(0, 256, (NUM_STARTS, spec.height, spec.width, 3), np.uint8)
        states = np.full((len(images), TOOL_DIM), 0.5, np.float32)
        count = spec.num_envs
        super().__init__(models, spec, (images, states), config.reward, num_envs=count, with_goals=False)
        self._frames, self._signal = np.repeat(images[:1], count, 0), np.zeros(count, np.float32)

    def _predict(
        self, actions: FloatArray, moved: FloatArray, valid: BoolArray
    ) -> tuple[UInt8Array, FloatArray, FloatArray]:
        return self._frames, self._signal, self._signal


class FreePolicy(ImagePolicy):
    """A policy whose networks cost nothing."""

    def act(
        self, images: UInt8Array, states: FloatArray, generator: torch.Generator | None = None, *,
        noise: FloatArray | None = None,
    ) -> PolicyOutput:
        count = len(images)
        zeros = np.zeros(count, np.float32)
        return PolicyOutput(np.zeros((count, TOOL_DIM), np.float32), zeros, zeros)


def host_points(plan: Plan, config: RunConfig) -> Iterator[Point]:
    """Steps/s that no device exceeds: of the loop over host arrays with costless models, and of drawing what a rollout
    on the device is told."""

    def measure(watch: Stopwatch, envs: int) -> list[float]:
        models = models_of(shipped_model(config.task))
        env = FreeEnvironment(models, configured_spec(config, envs), config)
        policy = FreePolicy(ImageEncoder(lambda images: images, 1), TOOL_DIM, TOOL_DIM, config.policy)
        reward = RuleReward()
        work = partial(collect_rollout, env, policy, reward, plan.num_steps, config.seed, 1)
        return [plan.num_steps * envs / s for s in watch.repeats(work)]

    def draws(watch: Stopwatch, envs: int) -> list[float]:
        def draw() -> None:
            rollout_starts(config.seed, 1, plan.num_steps, envs, NUM_STARTS)
            for step in range(plan.num_steps):
                action_noise(config.seed, 1, step, envs, TOOL_DIM)

        return [plan.num_steps * envs / s for s in watch.repeats(draw)]

    for envs in plan.host_envs:
        drawn = {"what": "starts and noise of a device's rollout", "envs": envs}
        yield Point("host", drawn, "steps/s", partial(draws, envs=envs))
        what = {"what": "loop without models", "px": config.simulation.image_size, "envs": envs}
        yield Point("host", what, "steps/s", partial(measure, envs=envs))


def simulator_points(plan: Plan, config: RunConfig) -> Iterator[Point]:
    """ManiSkill with rendering, a process per core: our scene, and its own task."""
    cores = sorted(os.sched_getaffinity(0))

    def measure(watch: Stopwatch, kind: str) -> list[float]:
        kinds, missing = simulator_kinds(config)
        if kind not in kinds:
            raise RunError(missing or f"ManiSkill has no task of its own for {config.task}")
        with simulator_workers(config, cores, kinds[kind]) as workers:
            return interleave([partial(rate_workers, workers)], plan.simulator_blocks)[0]

    for kind, scene in (("simulator", "our scene"), ("stock", "its own task")) if plan.simulator_blocks else ():
        what = {"what": f"ManiSkill, {scene}", "processes": len(cores)}
        yield Point("simulator", what, "steps/s", partial(measure, kind=kind))
