"""The imagined environment as one tensor program: a step that waits for nothing and copies nothing up or down.

ImaginedEnvironment serves numpy pictures, and so a copy each way per step; here everything stays where the models are,
in memory of fixed shape that changes in place, so that a GPU can run a step as one captured graph. Same starts, same
actions, same numbers: on a CPU bit for bit for up to parts.PART environments, beyond that up to the rounding of another
batch size.

Shapes: N environments, M starts, S tokens, D values per token, A action, P state, H W 3 image.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from wm_nodes.config.schema import RewardConfig
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.tool_control import commanded_columns, moves_pose, next_state_tensor
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.world_model.dynamics import task_done_signal
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.imagined_environment import (
    ImaginedEnvironment,
    encode_starts,
    imagine_start_goals,
    models_to_infer,
    world_model_spec,
)
from wm_nodes.world_model.imagined_episodes import task_indices
from wm_nodes.world_model.precision import has_fast_bfloat16


@dataclass(frozen=True)
class DeviceStep:
    """What one lock-step gives, as StepResult; all (N,), bool but for signal_N and uncertainty_N, float32."""

    terminated_N: Tensor
    truncated_N: Tensor
    valid_N: Tensor
    signal_N: Tensor
    uncertainty_N: Tensor


class DeviceEnvironment:
    """N imagined environments on the models' device, by the rules of ImaginedEnvironment.

    reset(), encode() and step() are fixed-shape and in place: resets are masks, ends are flags. Call them without
    gradients. Nothing is checked on the way; `finite` says afterwards whether the model has predicted NaN.

    Attributes:
        frames_NHWC: uint8. states_NP: float32. starts_N: int64, the start of each environment's episode.
        finite: bool (), False for good once a latent was not finite.
        goals: goal frame uint8 (M, H, W, 3) and found flag (M,) of every start, on the host; None without goals.

    Args:
        spec, starts, reward, instructions, with_goals, exact: as ImaginedEnvironment's.
        fixed: see RingTimes; by default on all devices but the CPU.
    """

    def __init__(
        self, models: WorldModels, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig,
        *, num_envs: int, instructions: Sequence[str] = (), with_goals: bool = True, exact: bool = False,
        fixed: bool | None = None,
    ) -> None:
        self.spec, self.device = world_model_spec(models, spec, num_envs), models.tokenizer.device
        self.tokenizer_sha256 = models.tokenizer_sha256
        self._reward = reward
        images, states = starts
        self.num_starts = len(images)
        self.goals: tuple[UInt8Array, BoolArray] | None = (
            imagine_start_goals(models, starts, self.spec, reward, instructions) if with_goals else None
        )
        self._fast, self._exact = has_fast_bfloat16(self.device), exact
        self._tokenizer, self._action = models_to_infer(models, exact=exact)
        self._start_frames = torch.from_numpy(images).to(self.device)
        self._start_states = torch.from_numpy(states).to(self.device, torch.float32)
        self._start_latents = encode_starts(models, images).clone()
        self._start_tasks = torch.from_numpy(task_indices(states, spec, models.task_index)).to(self.device)
        self._tool = spec.tool_dim
        self._commanded = torch.tensor(commanded_columns(spec), dtype=torch.int64).to(self.device)
        self._scale = torch.tensor(spec.action_scale, dtype=torch.float32).to(self.device)
        box = torch.tensor((spec.state_low, spec.state_high), dtype=torch.float32)
        self._box = box.to(self.device) if spec.state_low else None
        self._caches = models.action.trunk.new_ring_caches(num_envs, self.device, fixed=fixed)
        self._latents = self._start_latents[:1].repeat(num_envs, 1, 1)
        self.frames_NHWC = self._start_frames[:1].repeat(num_envs, 1, 1, 1)
        self.states_NP = self._start_states[:1].repeat(num_envs, 1)
        self.starts_N = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._steps_N = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        self._ended_N = torch.ones(num_envs, dtype=torch.bool, device=self.device)
        self.finite = torch.ones((), dtype=torch.bool, device=self.device)

    @classmethod
    def beside(cls, environment: ImaginedEnvironment) -> "DeviceEnvironment":
        """The same model, starts, rules and number of environments, with a state of its own.

        Raises:
            ValueError: an environment with picture noise or a second model.
        """
        if environment.picture_noise or environment.second:
            raise ValueError(
                "device rollouts know neither imagined_environment.picture_noise nor second_model; leave them unset, "
                "or leave the rollouts to the graph"
            )
        return cls(
            environment.models, environment.spec, environment.starts, environment.reward,
            num_envs=environment.spec.num_envs, instructions=environment.instructions,
            with_goals=environment.reward.dense_weight > 0,
        )

    def reset(self, begins_N: Tensor, starts_N: Tensor) -> None:
        """Begin an episode at start starts_N (int64, below M) where begins_N is True."""
        self.starts_N.copy_(torch.where(begins_N, starts_N, self.starts_N))
        for now, first in (
            (self._latents, self._start_latents), (self.frames_NHWC, self._start_frames),
            (self.states_NP, self._start_states),
        ):
            where = begins_N.view(-1, *[1] * (now.ndim - 1))
            now.copy_(torch.where(where, first[self.starts_N], now))
        self._caches[0].restart(begins_N)
        self._steps_N.masked_fill_(begins_N, 0)
        self._ended_N.masked_fill_(begins_N, False)

    def encode(self, *, positions: bool = False) -> Tensor:
        """Features (N, F) float32 of the frames shown for a policy: Tokenizer.flatten of Tokenizer.encode."""
        with self._autocast():
            latents = self._tokenizer.bottleneck(
                self._tokenizer.features(self.frames_NHWC.permute(0, 3, 1, 2).float() / 255)
            )
            return self._tokenizer.flatten(latents, positions=positions)

    def step(self, actions_NA: Tensor) -> DeviceStep:
        """Take one step with actions in [-1, 1] wherever the episode has not ended."""
        valid = ~self._ended_N
        moved = self._move(actions_NA)
        with self._autocast(exact=self._exact):
            latents, logits = self._action.advance(
                self._latents, actions_NA, self.states_NP[:, : self._tool], moved[:, : self._tool], self._caches
            )
        self._latents.copy_(torch.where(valid[:, None, None], latents, self._latents))
        self.finite.logical_and_(torch.isfinite(self._latents).all())
        with self._autocast():
            pixels = self._tokenizer.decode_pixels(self._latents)
        frames = pixels.clamp_(0, 1).mul_(255).round_().to(torch.uint8).permute(0, 2, 3, 1)
        self.frames_NHWC.copy_(torch.where(valid[:, None, None, None], frames, self.frames_NHWC))
        self.states_NP.copy_(torch.where(valid[:, None], moved, self.states_NP))
        self._steps_N.add_(valid)
        signal, spread = task_done_signal(logits, self._start_tasks[self.starts_N])
        terminated = valid & (signal > self._reward.success_threshold)
        over = self._steps_N >= self.spec.max_episode_steps
        if self._reward.uncertainty_limit > 0:
            over = over | (spread > self._reward.uncertainty_limit)
        truncated = valid & ~terminated & over
        self._ended_N.logical_or_(terminated | truncated)
        return DeviceStep(terminated, truncated, valid, signal, spread)

    def close(self) -> None:
        return None

    def _move(self, actions_NA: Tensor) -> Tensor:
        """States (N, P) that a step reaches: what is commanded, and what the model says of the rest."""
        change, states, kept = self._action.state_change, self.states_NP, self._commanded
        if len(kept) and change is None:
            return next_state_tensor(states, actions_NA, self._scale, self._box, pose=moves_pose(self.spec))
        moved = states.clone()
        if change is None:
            return moved
        if len(kept):
            box = None if self._box is None else self._box[:, kept]
            now = next_state_tensor(states[:, kept], actions_NA, self._scale, box, pose=moves_pose(self.spec))
            moved = moved.index_copy(1, kept, now)
        tool = self._tool
        with self._autocast(exact=self._exact):
            predicted = change.next_states(self._latents, actions_NA, states[:, :tool], moved[:, :tool])
        return torch.cat([predicted, moved[:, tool:]], 1)

    def _autocast(self, *, exact: bool = False) -> torch.autocast:
        """As compute_context; the device was asked once. A captured graph cannot keep a cache of casts."""
        enabled = self._fast and not exact
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled, cache_enabled=False)
