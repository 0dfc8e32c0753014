"""Rollouts: collected in lock-step inside one process (RS-9), step for step as the graph does over DDS; as the tensors
that a learner computes with; and their statistics.

An environment that has ended is reset in the next lock-step instead of stepped, so that column of the rollout is
invalid there. Seeds of resets and action noise depend on (seed, policy version, lock-step) only.

Shapes: T time, N environments, F features, S state, A action, H W 3 image.
"""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.seed_ranges import EVALUATION
from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.seeding import numpy_stream, torch_stream
from wm_nodes.core.types import BoolArray, Environment, FloatArray, Rollout, StepResult, UInt8Array, UInt64Array
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.reward import RewardInput, RewardModel


class Canceled(Exception):
    """The caller's should_stop returned True; nothing has changed."""


@dataclass(frozen=True)
class TensorRollout:
    """T lock-steps of N environments, as Rollout, on one device, with a policy's features in place of pictures."""

    features_TN: Tensor
    """float32 (T, N, F), of the observations that the actions answer."""
    next_features_TN: Tensor
    """float32 (T, N, F), of the observations that the steps reached; they count only where needs_bootstrap()."""
    states_TN: Tensor
    """float32 (T, N, S)."""
    next_states_TN: Tensor
    """float32 (T, N, S); they count as next_features_TN does."""
    actions_TN: Tensor
    """float32 (T, N, A), executed."""
    logprobs_TN: Tensor
    """float32 (T, N), nats; NaN where unknown."""
    values_TN: Tensor
    """float32 (T, N), the critic's; NaN where unknown."""
    rewards_TN: Tensor
    """float32 (T, N), NaN where there is none."""
    terminated_TN: Tensor
    """bool (T, N), as in StepResult."""
    truncated_TN: Tensor
    """bool (T, N), as in StepResult."""
    valid_TN: Tensor
    """bool (T, N), a step was made and has a reward."""
    policy_version: int
    """The learner step whose weights acted."""
    images: Tensor | None = None
    """uint8 (T + 1, N, H, W, 3), what the environments showed before every step and after the last; None where the
    pictures were never here."""

    def needs_bootstrap(self) -> Tensor:
        """Where (T, N) the value of the observation that a step reached is no other row's: at cuts, before a missing
        step, and at the end."""
        return _needs_bootstrap(self.valid_TN, self.terminated_TN, self.truncated_TN)

    def pictures(self, envs: slice = slice(None)) -> UInt8Array:
        """Copy pictures (T + 1, n, H, W, 3) of the environments `envs` to the host. Raises ValueError without any."""
        if self.images is None:
            raise ValueError("this rollout has no pictures; its Rollout holds them")
        pictures: UInt8Array = self.images[:, envs].cpu().numpy()
        return pictures


_R = TypeVar("_R", bound=Rollout | TensorRollout)


@torch.no_grad()
def tensors_of(rollout: Rollout | TensorRollout, policy: ImagePolicy) -> TensorRollout:
    """The rollout with the features of `policy`, on its device; those of reached observations only where needed. One
    that is there already is returned as it is."""
    if isinstance(rollout, TensorRollout):
        return rollout

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(policy.device)

    steps, num_envs = rollout.valid_TN.shape
    flags = (torch.from_numpy(flag) for flag in (rollout.valid_TN, rollout.terminated_TN, rollout.truncated_TN))
    needed = np.flatnonzero(_needs_bootstrap(*flags).numpy())  # on the host, which need not ask the device
    images, reached = (i.reshape(-1, *i.shape[2:]) for i in (rollout.images_TN, rollout.next_images_TN))
    features = policy.features(images)
    following = torch.zeros_like(features)
    following[tensor(needed)] = policy.features(reached[needed])
    shape = (steps, num_envs, -1)
    return TensorRollout(
        features.view(shape), following.view(shape), tensor(rollout.states_TN), tensor(rollout.next_states_TN),
        tensor(rollout.actions_TN), tensor(rollout.logprobs_TN), tensor(rollout.values_TN),
        tensor(rollout.rewards_TN), tensor(rollout.terminated_TN), tensor(rollout.truncated_TN),
        tensor(rollout.valid_TN), rollout.policy_version,
    )


def _needs_bootstrap(valid_TN: Tensor, terminated_TN: Tensor, truncated_TN: Tensor) -> Tensor:
    next_lost_TN = torch.ones_like(valid_TN)
    next_lost_TN[:-1] = ~valid_TN[1:]
    return valid_TN & ~terminated_TN & (truncated_TN | next_lost_TN)


@dataclass(frozen=True)
class RolloutStatistics:
    """Of each environment's first episode, which began with the rollout. NaN means that none ended inside it.

    A later episode has less time: it would be counted where it succeeds early, and not where it fails.
    """

    episodes: int
    """First episodes that ended inside the rollout."""
    successes: int
    """Of these, those that are done (the environment's own signal)."""
    mean_return: float
    """Of the ended ones."""
    mean_length: float
    """Of the ended ones, steps."""
    begun: int
    """All first episodes."""
    cut: int
    """Episodes, first or later, that the rollout's end cut short."""

    @property
    def success_rate(self) -> float:
        """Share of the first episodes that succeeded inside the rollout; those cut short did not."""
        return self.successes / self.begun if self.episodes else float("nan")

    def unfailed_after(self, unfailed: int) -> int:
        """Updates in a row without a failed episode, this rollout's included, `unfailed` of them before it."""
        return unfailed + 1 if self.success_rate == 1.0 else 0


@dataclass
class Convergence:
    """Says when training has converged (ppo.converged_updates)."""

    wanted: int
    """Updates in a row in whose rollouts no episode fails; 0: never."""
    unfailed: int = 0
    """Those up to the newest update."""

    def reached(self, rollout: Rollout | TensorRollout) -> bool:
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
        ended = result.ended & result.valid
    return Rollout(policy_version=policy_version, **{name: np.stack(rows) for name, rows in columns.items()})


def reward_input(
    images: UInt8Array, next_images: UInt8Array, step: StepResult | LockStep, goals: tuple[UInt8Array, BoolArray] | None
) -> RewardInput:
    """Return what a reward model needs of one lock-step. goals: env.goals() as of before the step."""
    frames, known = goals if goals is not None else (None, None)
    return RewardInput(
        images, next_images, step.success_probability, step.valid, step.uncertainty, goals=frames, goal_found=known
    )


def terminate_at_episode_end(rollout: _R) -> _R:
    """Return the rollout with truncated episodes as terminated ones, for rewards that come once, at the last step.

    A truncated episode has its whole reward then. Bootstrapping with the critic's value would count it twice, and an
    episode that fails until its time is over could be worth more than one that succeeds.
    """
    ended = rollout.terminated_TN | rollout.truncated_TN
    return replace(rollout, terminated_TN=ended, truncated_TN=ended & ~ended)  # type: ignore[arg-type]


def rollout_statistics(rollout: Rollout | TensorRollout) -> RolloutStatistics:
    """Return counts and means of the first episodes of the rollout, see RolloutStatistics.

    The return of an episode with an invalid step in its middle leaves that step out.
    """
    rewards_TN, terminated_TN, truncated_TN, valid_TN = _outcomes(rollout)
    ended_TN = terminated_TN | truncated_TN
    ended_N = ended_TN.any(0)
    first_TN: BoolArray = np.cumsum(ended_TN, 0) - ended_TN == 0
    returns_N = np.where(first_TN & valid_TN, rewards_TN, 0.0).sum(0, dtype=np.float64)
    lengths_N = (first_TN & (valid_TN | ended_TN)).sum(0)
    successes, episodes = int((first_TN & terminated_TN & ~truncated_TN).sum()), int(ended_N.sum())
    begun = int((ended_N | valid_TN.any(0)).sum())
    last_TN: BoolArray = np.cumsum(ended_TN[::-1], 0)[::-1] == 0
    cut = int((last_TN & valid_TN).any(0).sum())
    if not episodes:
        return RolloutStatistics(0, 0, float("nan"), float("nan"), begun, cut)
    mean_return, mean_length = (float(column[ended_N].mean()) for column in (returns_N, lengths_N))
    return RolloutStatistics(episodes, successes, mean_return, mean_length, begun, cut)


def _outcomes(rollout: Rollout | TensorRollout) -> tuple[FloatArray, BoolArray, BoolArray, BoolArray]:
    """Rewards, terminated, truncated and valid (T, N) on the host."""
    if isinstance(rollout, Rollout):
        return rollout.rewards_TN, rollout.terminated_TN, rollout.truncated_TN, rollout.valid_TN
    columns = rollout.rewards_TN, rollout.terminated_TN, rollout.truncated_TN, rollout.valid_TN
    rewards, *flags = torch.stack([column.float() for column in columns]).cpu().numpy()  # in one copy
    terminated, truncated, valid = (flag.astype(np.bool_) for flag in flags)
    return rewards, terminated, truncated, valid
