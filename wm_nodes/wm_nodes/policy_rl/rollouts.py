"""Collects rollouts in lock-step inside one process (RS-9), step for step as the graph does over DDS.

Shapes: T time, N environments. An environment that has ended is reset in the next lock-step instead of stepped, so that
column of the rollout is invalid there. Seeds of resets and action noise depend on (seed, policy version, lock-step)
only.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wm_nodes.config.seed_ranges import EVALUATION
from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.seeding import numpy_stream, torch_stream
from wm_nodes.core.types import BoolArray, Environment, FloatArray, Rollout, StepResult, UInt8Array, UInt64Array
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.tensor_rollout import Outcomes, TensorRollout
from wm_nodes.reward import RewardInput, RewardModel


class Canceled(Exception):
    """The caller's should_stop returned True; nothing has changed."""


@dataclass(frozen=True)
class RolloutStatistics:
    """Of each environment's first episode, which began with the rollout. NaN means that none ended inside it.

    A later episode has less time: it would be counted where it succeeds early, and not where it fails.

    episodes: that ended inside the rollout; mean_return and mean_length (steps) are theirs. successes: of them, those
    that terminated (the environment's own done signal). begun: all of them. cut: episodes, first or later, that the
    rollout's end cut short.
    """

    episodes: int
    successes: int
    mean_return: float
    mean_length: float
    begun: int
    cut: int

    @property
    def success_rate(self) -> float:
        """Share of the first episodes that succeeded inside the rollout; those cut short did not."""
        return self.successes / self.begun if self.episodes else float("nan")

    def unfailed_after(self, unfailed: int) -> int:
        """Updates in a row without a failed episode, this rollout's included, `unfailed` of them before it."""
        return unfailed + 1 if self.success_rate == 1.0 else 0


@dataclass
class Convergence:
    """Says when training has converged (ppo.converged_updates).

    wanted: updates in a row in whose rollouts no episode fails; 0: never. unfailed: those up to the newest update.
    """

    wanted: int
    unfailed: int = 0

    def reached(self, rollout: Outcomes | TensorRollout) -> bool:
        """Count the rollout of one more update; return whether training has converged."""
        self.unfailed = rollout_statistics(rollout).unfailed_after(self.unfailed)
        return 0 < self.wanted <= self.unfailed


def reset_seeds(
    seed: int, policy_version: int, step: int, num_envs: int, envs_per_start: int = 1
) -> UInt64Array:
    """Return the (N,) reset seeds of lock-step `step` (stream `reset`); entry i is used where environment i resets.

    Neighbours have one seed in groups of envs_per_start. Raises ValueError where these are not whole.
    """
    check_whole_groups(num_envs, envs_per_start)
    stream = numpy_stream(seed, "reset", policy_version, step)
    return stream.integers(0, EVALUATION.first, num_envs // envs_per_start, dtype=np.uint64).repeat(envs_per_start)


def check_whole_groups(num_envs: int, group_size: int) -> None:
    """Raise ValueError unless the environments are whole groups."""
    if num_envs % group_size:
        raise ValueError(
            f"{num_envs} environments are not whole groups of {group_size}; set ppo.num_envs to a multiple of "
            "ppo.group_size"
        )


def action_noise(seed: int, policy_version: int, step: int, num_envs: int, action_dim: int) -> FloatArray:
    """Return the (N, A) standard-normal action noise of lock-step `step` (stream `action_noise`)."""
    generator = torch_stream(seed, "action_noise", policy_version, step)
    noise: FloatArray = torch.randn(num_envs, action_dim, generator=generator).numpy()
    return noise


def collect_rollout(
    env: Environment, policy: ImagePolicy, reward: RewardModel, steps: int, seed: int, policy_version: int,
    envs_per_start: int = 1,
) -> Rollout:
    """Reset all environments and make `steps` lock-steps. Raises ValueError for steps < 1, and as reset_seeds.

    seed: root of the streams `reset` and `action_noise`. policy_version: learner step whose weights act.
    envs_per_start: as of reset_seeds.
    """
    if steps < 1:
        raise ValueError(f"steps must be >= 1, got {steps}; see ppo.num_steps in presets/policy/base.yaml")
    num_envs, action_dim = env.spec.num_envs, env.spec.action_dim
    observation = env.reset(None, reset_seeds(seed, policy_version, 0, num_envs, envs_per_start))
    ended = np.zeros(num_envs, np.bool_)
    columns: dict[str, list[NDArray[Any]]] = {}
    for step in range(steps):
        noise = action_noise(seed, policy_version, step, num_envs, action_dim)
        output = policy.act(observation.image, observation.state, noise=noise)
        goals = env.goals()
        result = env.step(output.actions)
        rewards = reward.evaluate(reward_input(observation.image, result.observation.image, result, goals))
        row: dict[str, NDArray[Any]] = {
            "images_TN": observation.image,
            "states_TN": observation.state,
            "next_images_TN": result.observation.image,
            "next_states_TN": result.observation.state,
            "actions_TN": output.actions,
            "logprobs_TN": output.logprobs,
            "values_TN": output.values,
            "rewards_TN": rewards.total,
            "terminated_TN": result.terminated & result.valid,
            "truncated_TN": result.truncated & result.valid,
            "valid_TN": result.valid & rewards.valid,
        }
        for name, array in row.items():
            columns.setdefault(name, []).append(array)
        observation = result.observation
        if ended.any():
            observation = env.reset(ended, reset_seeds(seed, policy_version, step, num_envs, envs_per_start))
        ended = (result.terminated | result.truncated) & result.valid
    return Rollout(policy_version=policy_version, **{name: np.stack(rows) for name, rows in columns.items()})


def reward_input(
    images: UInt8Array, next_images: UInt8Array, step: StepResult | LockStep, goals: tuple[UInt8Array, BoolArray] | None
) -> RewardInput:
    """Return what a reward model needs of one lock-step. goals: env.goals() as of before the step."""
    frames, known = goals if goals is not None else (None, None)
    return RewardInput(
        images, next_images, step.success_probability, step.valid, step.uncertainty, goals=frames, goal_found=known
    )


def terminate_at_episode_end(rollout: Rollout) -> Rollout:
    """Return the rollout with truncated episodes as terminated ones, for rewards that come once, at the last step.

    A truncated episode has its whole reward then. Bootstrapping with the critic's value would count it twice, and an
    episode that fails until its time is over could be worth more than one that succeeds.
    """
    ended = rollout.terminated_TN | rollout.truncated_TN
    return replace(rollout, terminated_TN=ended, truncated_TN=np.zeros_like(ended))


def rollout_statistics(rollout: Outcomes | TensorRollout) -> RolloutStatistics:
    """Return counts and means of the first episodes of the rollout, see RolloutStatistics.

    The return of an episode with an invalid step in its middle leaves that step out.
    """
    if isinstance(rollout, TensorRollout):
        rollout = rollout.outcomes()
    ended_TN = rollout.terminated_TN | rollout.truncated_TN
    ended_N = ended_TN.any(0)
    first_TN: BoolArray = np.cumsum(ended_TN, 0) - ended_TN == 0
    returns_N = np.where(first_TN & rollout.valid_TN, rollout.rewards_TN, 0.0).sum(0, dtype=np.float64)
    lengths_N = (first_TN & (rollout.valid_TN | ended_TN)).sum(0)
    successes, episodes = int((first_TN & rollout.terminated_TN).sum()), int(ended_N.sum())
    begun = int((ended_N | rollout.valid_TN.any(0)).sum())
    last_TN: BoolArray = np.cumsum(ended_TN[::-1], 0)[::-1] == 0
    cut = int((last_TN & rollout.valid_TN).any(0).sum())
    if not episodes:
        return RolloutStatistics(0, 0, float("nan"), float("nan"), begun, cut)
    mean_return, mean_length = (float(column[ended_N].mean()) for column in (returns_N, lengths_N))
    return RolloutStatistics(episodes, successes, mean_return, mean_length, begun, cut)
