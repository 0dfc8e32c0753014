"""Success of a policy on given reset seeds, over a batch of environments. Shapes: E episodes, N environments, G numbers
of ground truth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from wm_nodes.core.seeding import torch_stream
from wm_nodes.core.statistics import wilson_interval
from wm_nodes.core.types import BoolArray, Environment, FloatArray, Observation, UInt64Array
from wm_nodes.policy_rl.image_policy import ImagePolicy

ROWS = 16
"""Of each call of the policy, the last one filled up: products of another number of rows may round otherwise."""


@dataclass(frozen=True)
class EvaluationResult:
    """E episodes of one policy; arrays in the order of the seeds first_seed, first_seed + 1, ..."""

    success: BoolArray
    """bool (E,), the task was done before the step limit."""
    length: NDArray[np.uint32]
    """uint32 (E,), steps made."""
    first_seed: int
    """Reset seed of the first episode."""
    low: float
    """Lower end of the 95 % Wilson interval of the success rate."""
    high: float
    """Upper end of that interval."""
    largest: FloatArray
    """float32 (E, G), of each number of the ground truth in the episode; NaN where the environment says none."""

    @property
    def episodes(self) -> int:
        return len(self.success)

    @property
    def successes(self) -> int:
        return int(self.success.sum())

    @property
    def success_rate(self) -> float:
        return self.successes / self.episodes

    @property
    def mean_length(self) -> float:
        return float(self.length.mean())


def evaluate(
    policy: ImagePolicy, env: Environment, episodes: int, first_seed: int, deterministic: bool = True, *,
    on_progress: Callable[[int, int], None] = lambda done, successes: None,
) -> EvaluationResult:
    """Play one episode per seed. Environments that finish take the next seed, so none waits for the slowest.

    Action noise, where not deterministic, comes from the stream (episode seed, step), and the policy acts on ROWS rows
    at a time: an episode does not depend on the environment that plays it, on the others, or on their number.

    Args:
        on_progress: called with (episodes done, successes); may raise to stop.

    Raises:
        ValueError: episodes < 1.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {episodes}; see evaluation.episodes in presets/policy/base.yaml")
    num_envs = env.spec.num_envs
    playing = np.where(np.arange(num_envs) < episodes, np.arange(num_envs), -1)
    next_episode = min(num_envs, episodes)
    success = np.zeros(episodes, np.bool_)
    length = np.zeros(episodes, np.uint32)
    largest = np.full((episodes, env.spec.ground_truth_dim), np.nan, np.float32)
    done = 0
    observation = env.reset(None, _seeds(first_seed, playing))
    while done < episodes:
        noise = None
        if not deterministic:
            noise = np.stack([
                _noise(first_seed + max(int(episode), 0), int(step), env.spec.action_dim)
                for episode, step in zip(playing, observation.episode_step, strict=True)
            ])
        result = env.step(act_in_rows(policy, observation, noise))
        observation = result.observation
        played = result.valid & (playing >= 0)
        largest[playing[played]] = np.fmax(largest[playing[played]], result.ground_truth[played])
        ended = result.ended & played
        if not ended.any():
            continue
        success[playing[ended]] = result.success[ended]
        length[playing[ended]] = observation.episode_step[ended]
        done += int(ended.sum())
        waiting = np.flatnonzero(ended)
        refilled = waiting[: episodes - next_episode]
        playing[waiting] = -1
        playing[refilled] = np.arange(next_episode, next_episode + len(refilled))
        next_episode += len(refilled)
        if len(refilled):
            mask = np.zeros(num_envs, np.bool_)
            mask[refilled] = True
            observation = env.reset(mask, _seeds(first_seed, playing))
        on_progress(done, int(success.sum()))
    low, high = wilson_interval(int(success.sum()), episodes)
    return EvaluationResult(success, length, first_seed, low, high, largest)


def act_in_rows(policy: ImagePolicy, seen: Observation, noise: FloatArray | None = None) -> FloatArray:
    """Return actions (N, A), from calls of ROWS rows: those of an environment do not depend on how many there are.

    noise: as of ImagePolicy.act; None acts without.
    """
    num_envs = len(seen.image)
    calls = np.arange(num_envs + -num_envs % ROWS).reshape(-1, ROWS) % num_envs
    actions = [
        policy.act(seen.image[rows], seen.state[rows], noise=None if noise is None else noise[rows]).actions
        for rows in calls
    ]
    return np.concatenate(actions)[:num_envs]


def _seeds(first_seed: int, playing: NDArray[np.int64]) -> UInt64Array:
    return (first_seed + np.maximum(playing, 0)).astype(np.uint64)


def _noise(seed: int, step: int, action_dim: int) -> NDArray[np.float32]:
    noise: NDArray[np.float32] = torch.randn(action_dim, generator=torch_stream(seed, "evaluation_noise", step)).numpy()
    return noise
