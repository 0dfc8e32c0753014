"""Collects rollouts of an imagined environment that never leave its device: collect_rollout as a tensor program.

A lock-step (reset, encode, act, step) is fixed in shape and in place; on a GPU it is captured once as a CUDA graph and
replayed. Up go action noise and starts, once per rollout; nothing comes down but the answer whether all was finite.

Shapes: T time, N environments, M starts, F features, S state, A action.
"""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.core.device import explain_memory
from wm_nodes.core.types import Environment, Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import (
    TensorRollout,
    action_noise,
    collect_rollout,
    reset_seeds,
)
from wm_nodes.reward import EncoderDistance, EndogenousReward, RewardModel
from wm_nodes.reward.endogenous import progress_along
from wm_nodes.world_model import DeviceEnvironment, ImaginedEnvironment
from wm_nodes.world_model.starts import starts_of

MOST_GOLDEN_FRAMES = 4096
"""Goals that are compared with frames at once: features of golden trajectories at every step of a rollout are
gigabytes."""
WARM_UP_STEPS = 3

Step = Callable[[], None]


def rollout_starts(
    seed: int, policy_version: int, steps: int, num_envs: int, num_starts: int, envs_per_start: int = 1
) -> NDArray[np.int64]:
    """Return (T, N) starts; entry (t, i) is used where environment i begins an episode before lock-step t.

    They are those of ImaginedEnvironment with collect_rollout's reset_seeds.
    """
    seeds = [reset_seeds(seed, policy_version, max(0, step - 1), num_envs, envs_per_start) for step in range(steps)]
    return starts_of(np.stack(seeds), num_starts)


def make_collector(
    env: Environment | DeviceEnvironment, policy: ImagePolicy, reward: RewardModel, envs_per_start: int = 1
) -> Callable[[int, int, int], Rollout | TensorRollout]:
    """Return collect(steps, seed, policy version): on the device where `env` is a DeviceEnvironment, the reward follows
    golden trajectories, which stay there, or nobody needs pictures; else lock-step."""
    if isinstance(env, ImaginedEnvironment) and isinstance(reward, EndogenousReward) and (
        reward.config.needs_golden or (needs_no_pictures(env.episodes, policy, reward) and not env.picture_noise)
    ):
        env = DeviceEnvironment.beside(env)
    if isinstance(env, DeviceEnvironment):
        return partial(DeviceCollector(env, policy, reward).collect, envs_per_start=envs_per_start)
    return partial(collect_rollout, env, policy, reward, envs_per_start=envs_per_start)


def needs_no_pictures(env: DeviceEnvironment, policy: ImagePolicy, reward: RewardModel | None = None) -> bool:
    """Whether episodes are the same without pictures, which are most of the work: states alone say what happens
    (world_model.state_model_iterations), and nobody looks. reward: None: none is given."""
    pays_for_states = reward is None or (isinstance(reward, EndogenousReward) and reward.config.dense_weight == 0)
    return env.is_told and policy.encoder.inputs == "state" and pays_for_states


@contextmanager
def unseen_pictures_left_out(env: Environment, policy: ImagePolicy) -> Iterator[None]:
    """While the policy alone looks, leave pictures out that it does not see."""
    episodes = env.episodes if isinstance(env, ImaginedEnvironment) else None
    if episodes is None or not needs_no_pictures(episodes, policy):
        yield
        return
    episodes.pictures = False
    try:
        yield
    finally:
        episodes.pictures = True


class DeviceCollector:
    """Makes rollouts of `policy` in `env` with the endogenous reward.

    The policy is read where it is: train it in place.

    Args:
        capture: makes a faster function of a lock-step, or raises RuntimeError, which is warned of once and leaves the
            lock-step as it is; by default capture_graph on a GPU, nothing on a CPU.

    Raises:
        ValueError: another reward, or a policy or reward that sees through another encoder than the environment's.
    """

    def __init__(
        self, env: DeviceEnvironment, policy: ImagePolicy, reward: RewardModel, *,
        capture: Callable[[Step], Step] | None = None,
    ) -> None:
        self.env, self.policy = env, policy
        self._reward = _checked(reward, policy, env)
        env.pictures = not needs_no_pictures(env, policy, reward)
        self._goals = self._encode_goals()
        num_envs, device = env.spec.num_envs, env.device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(num_envs, *shape, dtype=dtype, device=device)

        self._noise_NA, self._starts_N = zeros(env.spec.action_dim), zeros(dtype=torch.int64)
        self._begins_N, self._just_ended_N = zeros(dtype=torch.bool), zeros(dtype=torch.bool)
        self._row: dict[str, Tensor] = {
            "features": zeros(policy.encoder.feature_dim),
            "states": zeros(env.spec.state_dim), "actions": zeros(env.spec.action_dim), "logprobs": zeros(),
            "values": zeros(), "signal": zeros(), "uncertainty": zeros(), "terminated": zeros(dtype=torch.bool),
            "truncated": zeros(dtype=torch.bool), "valid": zeros(dtype=torch.bool), "starts": zeros(dtype=torch.int64),
        }
        if env.pictures:
            self._row["images"] = torch.zeros_like(env.frames_NHWC)
        if self._goals is not None and policy.encoder.inputs == "positions":  # the reward compares latents
            self._row["latents"] = zeros(self._goals[0].shape[-1])
        self._run = self._captured(capture or (partial(capture_graph, device) if device.type == "cuda" else None))

    @torch.no_grad()
    def collect(
        self, steps: int, seed: int, policy_version: int, *, envs_per_start: int = 1,
        starts_TN: NDArray[np.int64] | None = None,
    ) -> TensorRollout:
        """Reset all environments and make `steps` lock-steps, as collect_rollout does.

        Args:
            envs_per_start: as of reset_seeds.
            starts_TN: where episodes begin, see rollout_starts, which gives them by default.

        Raises:
            ValueError: steps < 1, or starts of another shape or outside the environment's.
            FloatingPointError: the model predicted NaN. DeviceError: the GPU's memory is too small.
        """
        env, num_envs = self.env, self.env.spec.num_envs
        if steps < 1:
            raise ValueError(f"steps must be >= 1, got {steps}; see ppo.num_steps in presets/policy/base.yaml")
        if starts_TN is None:
            starts_TN = rollout_starts(seed, policy_version, steps, num_envs, env.num_starts, envs_per_start)
        if starts_TN.shape != (steps, num_envs) or not 0 <= starts_TN.min() <= starts_TN.max() < env.num_starts:
            raise ValueError(
                f"starts_TN must be ({steps}, {num_envs}) numbers of 0..{env.num_starts - 1}, got {starts_TN.shape} in "
                f"{starts_TN.min()}..{starts_TN.max()}"
            )
        draws = [action_noise(seed, policy_version, step, num_envs, env.spec.action_dim) for step in range(steps)]
        with explain_memory(env.device, ppo__num_envs=num_envs, ppo__num_steps=steps):
            noise, starts = (torch.from_numpy(array).to(env.device) for array in (np.stack(draws), starts_TN))
            return self._collect(noise, starts, policy_version)

    def _collect(self, noise: Tensor, starts: Tensor, policy_version: int) -> TensorRollout:
        env, steps = self.env, len(noise)
        self._begins_N.fill_(True)
        self._just_ended_N.fill_(False)
        env.finite.fill_(True)
        reached = ("images", "features", "states", "latents")  # one row more: what the last step reached
        columns = {
            name: row.new_empty(steps + (name in reached), *row.shape) for name, row in self._row.items()
        }
        for step in range(steps):
            self._noise_NA.copy_(noise[step])
            self._starts_N.copy_(starts[step])
            self._run()
            for name, column in columns.items():
                column[step].copy_(self._row[name])
        if "images" in columns:
            columns["images"][-1].copy_(env.frames_NHWC)
        columns["features"][-1].copy_(self._features())
        columns["states"][-1].copy_(env.states_NP)
        if "latents" in columns:
            columns["latents"][-1].copy_(env.encode())
        rewards, rewarded = self._rewards(columns)
        env.check_finite()
        features, states = columns["features"], columns["states"]
        return TensorRollout(
            features[:-1], features[1:], states[:-1], states[1:], columns["actions"], columns["logprobs"],
            columns["values"], rewards, columns["terminated"], columns["truncated"], columns["valid"] & rewarded,
            policy_version, columns.get("images"),
        )

    def _captured(self, capture: Callable[[Step], Step] | None) -> Step:
        if capture is None:
            return self._step
        try:
            return capture(self._step)
        except (RuntimeError, AssertionError) as error:  # a torch without CUDA asserts
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            warnings.warn(f"imagined lock-steps run without a CUDA graph, more slowly: {reason}", stacklevel=3)
            return self._step

    @torch.no_grad()
    def _step(self) -> None:
        """One lock-step; its results are in the row. An environment that ended is reset after one idle lock-step."""
        env, policy = self.env, self.policy
        env.reset(self._begins_N, self._starts_N)
        features = self._features()
        distribution = policy.distribution(features, env.states_NP)
        actions = distribution.executed(self._noise_NA)
        self._put(
            features=features, states=env.states_NP, actions=actions,
            logprobs=distribution.logprob(actions), values=policy.value(features, env.states_NP), starts=env.starts_N,
        )
        if "images" in self._row:
            self._put(images=env.frames_NHWC)
        if "latents" in self._row:
            self._put(latents=env.encode())
        result = env.step(actions)
        self._put(
            signal=result.signal_N, uncertainty=result.uncertainty_N, terminated=result.terminated_N,
            truncated=result.truncated_N, valid=result.valid_N,
        )
        self._begins_N.copy_(self._just_ended_N)
        self._just_ended_N.copy_(result.terminated_N | result.truncated_N)

    def _features(self) -> Tensor:
        return self.env.encode(self.policy.encoder.inputs)

    def _put(self, **values: Tensor) -> None:
        for name, value in values.items():
            self._row[name].copy_(value)

    def _rewards(self, columns: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Rewards (T, N), NaN where there is none, and where there is one: EndogenousReward.evaluate."""
        reward, signal, spread = self._reward, columns["signal"], columns["uncertainty"]
        valid = columns["valid"] & torch.isfinite(signal) & torch.isfinite(spread)
        rewards = reward.config.sparse_weight * reward.crossed(signal, spread).float()
        if self._goals is not None:
            (goals, found, _), starts = self._goals, columns["starts"]
            latents = columns.get("latents", columns["features"][..., : goals.shape[-1]])  # without positions
            together = max(1, MOST_GOLDEN_FRAMES // (goals.shape[1] * len(starts[0])))
            parts = (slice(i, i + together) for i in range(0, len(starts), together))
            dense = reward.config.dense_weight * torch.cat([
                reward.approach(*(self._near(seen[part], starts[part]) for seen in (latents[:-1], latents[1:])))
                for part in parts
            ])
            valid = valid & found[starts] & torch.isfinite(dense)
            rewards = dense + rewards
        return torch.where(valid, rewards, float("nan")), valid

    def _near(self, latents_TNF: Tensor, starts_TN: Tensor) -> Tensor:
        """How near to the goals of their starts the frames are (T, N), see EndogenousReward.approach."""
        assert self._goals is not None  # _rewards has looked
        goals, _, lengths = self._goals
        distances = _distance_of(self._reward).between(latents_TNF.unsqueeze(2), goals[starts_TN])
        if self._reward.config.mode == "progress":
            return progress_along(distances, lengths[starts_TN])
        return 1 - distances[..., 0]

    def _encode_goals(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """Features (M, K, F) of the starts' goals, one each, or of their golden trajectories, found flags (M,), and how
        many frames count (M,); None where the reward needs no goal."""
        if self._reward.config.dense_weight == 0:
            return None
        if (goals := self.env.goals()) is None:
            raise ValueError("reward.dense_weight needs goals, and this environment was made without; set it to 0")
        frames, found = goals[0][:, None], goals[1]
        lengths = np.ones(len(frames), np.int64)
        if self._reward.config.mode == "progress":
            if (golden := self.env.golden) is None:
                raise ValueError("reward.mode progress needs golden trajectories, and this environment was made for "
                                 "another mode; make it with the reward's settings")
            frames, lengths = golden.frames, golden.lengths
        device, features = self.env.device, _distance_of(self._reward).encode(frames.reshape(-1, *frames.shape[2:]))
        return (
            features.view(*frames.shape[:2], -1).to(device), torch.from_numpy(found).to(device),
            torch.from_numpy(lengths).to(device),
        )


def capture_graph(device: torch.device, step: Step) -> Step:
    """Return the replay of `step` as one CUDA graph on `device`. Raises RuntimeError where it cannot be captured."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device):
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP_STEPS):
                step()
        torch.cuda.current_stream().wait_stream(stream)
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # other threads may use the GPU meanwhile
            step()
    replay: Step = graph.replay
    return replay


def _checked(reward: RewardModel, policy: ImagePolicy, env: DeviceEnvironment) -> EndogenousReward:
    remedy = "use collect_rollout with an ImaginedEnvironment, where every reward and policy goes"
    if not isinstance(reward, EndogenousReward):
        raise ValueError(f"reward {reward.name} cannot be computed on the device; {remedy}")
    if policy.encoder.sha256 != env.tokenizer_sha256:
        raise ValueError(f"the policy's encoder is not the tokenizer of the world model; {remedy}")
    if reward.config.dense_weight > 0 and _distance_of(reward).identity != env.tokenizer_sha256[:16]:
        raise ValueError(f"the reward's distance is not that of the world model's tokenizer; {remedy}")
    return reward


def _distance_of(reward: EndogenousReward) -> EncoderDistance:
    if not isinstance(reward.distance, EncoderDistance):
        raise ValueError(
            f"distance {reward.distance.name} cannot be computed on the device; use EncoderDistance, or collect_rollout"
        )
    return reward.distance
