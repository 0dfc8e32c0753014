"""Collect simulator episodes straight into MCAP bags: parallel, resumable, with progress.

Work is cut into shards of `EPISODES_PER_SHARD` seeds, one bag each, renamed when complete: a second call with the same
arguments collects only the shards that are missing. A shard follows from its seeds, not from those before it.
"""

import functools
import multiprocessing as mp
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from wm_nodes.config.environments import SimulationConfig
from wm_nodes.config.seed_ranges import EVALUATION
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import Episode, FloatArray, Observation
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import EXTREME as EXTREME
from wm_nodes.environments.maniskill.episodes import SCATTERED as SCATTERED
from wm_nodes.environments.maniskill.episodes import planned_or_scripted_episode, record_episode, recovered_episode
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner
from wm_nodes.environments.maniskill.scenes import renew_physics

EPISODES_PER_SHARD = 50
POLICY_LABEL = "policy"
"""Episode.behaviour of an episode that a policy acted."""

PolicyAct = Callable[[Observation, int], FloatArray]
"""(observation of one slot, episode seed) -> action (A,)."""


@dataclass(frozen=True)
class CollectionPlan:
    """What to collect."""

    task: str
    """In whose scene."""
    simulation: SimulationConfig
    """Of the simulator."""
    num_episodes: int
    """In all."""
    first_seed: int
    """Episode i is reset with first_seed + i."""
    behaviours: dict[str, float]
    """Relative shares of the scripted behaviours; empty when a policy acts."""
    end_on_success: bool = False
    """False lets episodes run to the step limit, so that done heads see frames after success."""
    make_policy: Callable[[], PolicyAct] | None = None
    """Builds the acting policy inside a worker; must be picklable (a module-level function or a partial)."""
    policy_label: str = POLICY_LABEL
    """Episode.behaviour of its episodes."""
    policy_version: int = 0
    """Learner step of its weights."""
    recovers: bool = False
    """In each of the policy's episodes the script takes over, after up to half of the steps."""

    def __post_init__(self) -> None:
        """Raise ValueError for seeds of the evaluation."""
        first, last = self.first_seed, self.first_seed + self.num_episodes - 1
        if first < 0 or (first < EVALUATION.stop and last >= EVALUATION.first):
            raise ValueError(
                f"{self.num_episodes} episodes of reset seeds {first} to {last} cannot be collected: seeds begin at 0, "
                f"and {EVALUATION.first} to {EVALUATION.stop - 1} are those of the evaluation; choose another first one"
            )


WriteShard = Callable[[Path, CollectionPlan, list[Episode]], None]
"""Writes the episodes of one shard to a bag at the path; environments/record.py has the one that is used."""


def collect(folder: Path, plan: CollectionPlan, write_shard: WriteShard, *, num_workers: int) -> list[Path]:
    """Collect into `folder`/shard_<first seed>; returns the bags in seed order.

    Raises:
        NoRendererError: Vulkan finds no device.
        ValueError: unknown behaviour or task.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shards = [
        (folder / f"shard_{plan.first_seed + start:08d}", start, min(start + EPISODES_PER_SHARD, plan.num_episodes))
        for start in range(0, plan.num_episodes, EPISODES_PER_SHARD)
    ]
    missing = [shard for shard in shards if not shard[0].exists()]
    done = plan.num_episodes - sum(stop - start for _, start, stop in missing)
    with tqdm(total=plan.num_episodes, initial=done, unit="episode", desc="collect") as bar:
        workers = min(num_workers, len(missing))
        if workers == 1:  # a process of its own would only cost the seconds of its start
            for shard in missing:
                bar.update(_collect_shard(*shard, plan, write_shard))
        elif missing:
            with ProcessPoolExecutor(
                workers, mp_context=mp.get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
            ) as pool:
                futures = {pool.submit(_collect_shard, *shard, plan, write_shard): shard for shard in missing}
                for future in as_completed(futures):
                    bar.update(future.result())
    return [path for path, _, _ in shards]


def behaviour_of(seed: int, shares: dict[str, float]) -> str:
    """The behaviour that episode `seed` shows, drawn from the shares."""
    names = sorted(shares)
    weights = np.array([shares[name] for name in names])
    return str(numpy_stream(seed, "behaviour_kind").choice(names, p=weights / weights.sum()))


def _collect_shard(path: Path, start: int, stop: int, plan: CollectionPlan, write_shard: WriteShard) -> int:
    env = _worker_environment(plan.task, plan.simulation.model_dump_json(), plan.end_on_success)
    if not plan.simulation.scenes:  # those of the catalogue are built anew with every episode
        renew_physics(env.scene)
    act_episode = _make_policy_actor(env, plan) if plan.make_policy else _make_behaviour_actor(env, plan)
    write_shard(path, plan, [act_episode(plan.first_seed + i, i) for i in range(start, stop)])
    return stop - start


@functools.cache
def _worker_environment(task: str, simulation_json: str, end_on_success: bool) -> ManiSkillEnvironment:
    """One simulator per worker process: building it costs seconds. Its physics is renewed with every shard, not with
    every episode, so that demonstrations, and policies that begin with them, stay what they were.
    """
    config = SimulationConfig.model_validate_json(simulation_json)
    return ManiSkillEnvironment(task, config, 1, end_on_success=end_on_success, new_physics=False)


def _make_behaviour_actor(env: ManiSkillEnvironment, plan: CollectionPlan) -> Callable[[int, int], Episode]:
    planner = DemonstrationPlanner(env)

    def act_episode(seed: int, episode_id: int) -> Episode:
        return planned_or_scripted_episode(env, planner, behaviour_of(seed, plan.behaviours), seed, episode_id)

    return act_episode


def _make_policy_actor(env: ManiSkillEnvironment, plan: CollectionPlan) -> Callable[[int, int], Episode]:
    assert plan.make_policy is not None
    policy = plan.make_policy()

    def act_episode(seed: int, episode_id: int) -> Episode:
        env.reset(seeds=np.array([seed], np.uint64))

        def act(observation: Observation, _truth: FloatArray) -> FloatArray:
            return policy(observation, seed)

        if plan.recovers:
            return recovered_episode(env, act, seed, episode_id)
        return record_episode(env, act, plan.policy_label, seed, episode_id, plan.policy_version)

    return act_episode
