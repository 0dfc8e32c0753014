"""World model against simulator, each with the same cores: torch threads there, one process per core here.

The simulator twice: our scene, as the nodes use it, which draws less (docs/adr/0003), and ManiSkill's own task. No
episode ends early on any side, so that every step of every environment counts.
"""

import multiprocessing as mp
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.experiment import console
from benchmarks.speed.inputs import Effort, actions_of, interleave, seeds_of
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.errors import RunError
from wm_nodes.core.memory import keep_freed_memory
from wm_nodes.core.types import Environment, Rollout
from wm_nodes.policy_rl.device_rollout import make_collector, needs_no_pictures
from wm_nodes.policy_rl.factories import make_endogenous_reward, make_imagined_environment, make_policy
from wm_nodes.policy_rl.rollouts import TensorRollout, reward_input
from wm_nodes.reward import RewardModel, RuleReward

IMAGINED_ENVS, SIMULATOR_ENVS = 64, 4
STOCK = {"push_cube": "PushCube-v1", "pull_cube": "PullCube-v1"}
"""ManiSkill's own tasks."""
WORKER_TIMEOUT_S = 300.0

Serve = Callable[[RunConfig, int, Connection], None]
"""What a simulator's process runs: configuration, core, its end of the connection."""


def measure_simulator(config: RunConfig, effort: Effort, model: Path, starts: Path) -> dict[str, Any]:
    """imagined_steps_per_s: imagined_contender's, 64 environments, a torch thread per core;
    imagined_over_simulator: over those of our scene in ManiSkill with rendering and rule reward, a process per core.
    imagined_over_stock_simulator: over those of ManiSkill's own task with its own reward, as installed, two cameras of
    the same size and as much time per step. Resets are not counted, but in rollouts of imagined_contender."""
    cores = sorted(os.sched_getaffinity(0))
    kinds, missing = simulator_kinds(config)
    if missing:
        console.print(f"simulator left out: {missing}", highlight=False)
    console.print(f"world model against ManiSkill with rendering, {len(cores)} cores each", highlight=False)
    with ExitStack() as stack:
        contenders = {"imagined": imagined_contender(config, model, starts)}
        for kind, serve in kinds.items():
            contenders[kind] = partial(rate_workers, stack.enter_context(simulator_workers(config, cores, serve)))
        blocks = interleave([*contenders.values()], effort.simulator_blocks)
    rates = {kind: float(np.median(values)) for kind, values in zip(contenders, blocks, strict=True)}
    details: dict[str, Any] = {
        "imagined_envs": IMAGINED_ENVS, "imagined_threads": torch.get_num_threads(),
        "dense_weight": config.reward.dense_weight,
        "simulator_envs": SIMULATOR_ENVS, "simulator_processes": len(cores), "cores": len(cores), "missing": missing,
        "reward": "endogenous",
    }
    details |= {f"{kind}_steps_per_s": rates[kind] for kind in kinds}
    ratios = [rates["imagined"] / rates[kind] if kind in kinds else None for kind in ("simulator", "stock")]
    return {
        "imagined_steps_per_s": rates["imagined"], "imagined_over_simulator": ratios[0],
        "imagined_over_stock_simulator": ratios[1], "simulator": details,
    }


def imagined_contender(config: RunConfig, model: Path, starts: Path) -> Callable[[int], float]:
    """Steps per second of a block of the world model, with reward, to the step limit: as RL makes them, with what the
    policy does, where it needs no pictures, else of given actions."""
    endless = config.model_copy(update={"reward": config.reward.model_copy(update={"success_threshold": 1.0})})
    imagined = make_imagined_environment(endless, model, starts, num_envs=IMAGINED_ENVS, seed=config.seed)
    policy, reward = make_policy(config, model), make_endogenous_reward(config, model)
    if not needs_no_pictures(imagined.episodes, policy, reward):
        return partial(rate_episode, imagined, reward)
    collect = make_collector(imagined, policy, reward)
    return partial(rate_rollout, lambda block: collect(config.simulation.max_episode_steps, block, 0))


def simulator_kinds(config: RunConfig) -> tuple[dict[str, Serve], str]:
    """The simulators that can render here, by name, or else why none can."""
    from wm_nodes.environments.maniskill.backend import NoRendererError, render_backend

    try:
        render_backend(config.simulation.render_device)
    except NoRendererError as error:
        return {}, str(error)
    return {"simulator": _serve_blocks, **({"stock": _serve_stock} if config.task in STOCK else {})}, ""


@contextmanager
def simulator_workers(config: RunConfig, cores: list[int], serve: Serve) -> Iterator[list[Connection]]:
    """One process per core that runs serve(config, core, connection); idle until a block number comes."""
    context = mp.get_context("spawn")
    ends: list[Connection] = []
    processes = []
    try:
        for core in cores:
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(config, core, there), daemon=True)
            process.start()
            there.close()
            ends.append(here)
            processes.append(process)
        yield ends
    finally:
        for end in ends:
            end.close()
        for process in processes:
            process.join(10)
            if process.is_alive():
                process.terminate()


def _serve_blocks(config: RunConfig, core: int, commands: Connection) -> None:
    """Send the steps per second of every block that is asked for, until the other end closes."""
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    keep_freed_memory()
    from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment

    env = ManiSkillEnvironment(
        config.task, config.simulation, num_envs=SIMULATOR_ENVS, seed=config.seed + core, end_on_success=False
    )
    rule = RuleReward(config.reward.sparse_weight)
    try:
        while True:
            commands.send(rate_episode(env, rule, commands.recv()))
    except EOFError:
        env.close()


def _serve_stock(config: RunConfig, core: int, commands: Connection) -> None:
    """The same of ManiSkill's own task in one scene, which is all that a process has on a CPU."""
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    keep_freed_memory()
    from wm_nodes.environments.maniskill.scenes import make

    size = {"width": config.simulation.image_size, "height": config.simulation.image_size}
    env = make(STOCK[config.task], config.simulation, robot_uids="panda_wristcam", sensor_configs=size)
    try:
        while True:
            block = commands.recv()
            env.reset(seed=block)
            env.action_space.seed(block)
            start = time.perf_counter()
            for _ in range(config.simulation.max_episode_steps):
                env.step(env.action_space.sample())
            commands.send(config.simulation.max_episode_steps / (time.perf_counter() - start))
    except EOFError:
        env.close()


def rate_workers(workers: list[Connection], block: int) -> float:
    """Steps per second of all workers at once, each with scenes of its own.

    Raises:
        RunError: a worker ended or is silent for WORKER_TIMEOUT_S.
    """
    for index, worker in enumerate(workers):
        worker.send(block * len(workers) + index)
    total = 0.0
    for worker in workers:
        try:
            if not worker.poll(WORKER_TIMEOUT_S):
                raise RunError(f"a simulator process gave no answer for {WORKER_TIMEOUT_S:g} s; is memory short?")
            total += worker.recv()
        except EOFError:
            raise RunError("a simulator process ended; its error is above") from None
    return total


def rate_rollout(collect: Callable[[int], Rollout | TensorRollout], block: int) -> float:
    """Steps per second of the rollout that is collected for a block."""
    start = time.perf_counter()
    steps = int(collect(block).valid_TN.sum())
    return steps / (time.perf_counter() - start)


def rate_episode(env: Environment, reward: RewardModel, block: int) -> float:
    """Steps per second of a reset and then steps with rewards to the limit; environments that have ended do not count.

    Every goal counts as found: a reward without a goal would be skipped, and look fast.
    """
    observation = env.reset(None, seeds_of(env.spec, block))
    steps = 0
    start = time.perf_counter()
    for actions in actions_of(env.spec, block, env.spec.max_episode_steps):
        imagined = env.goals()
        goals = None if imagined is None else (imagined[0], np.ones_like(imagined[1]))
        result = env.step(actions)
        reward.evaluate(reward_input(observation.image, result.observation.image, result, goals))
        observation = result.observation
        steps += int(result.valid.sum())
    return steps / (time.perf_counter() - start)
