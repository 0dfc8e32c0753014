"""What every imagined environment shares: real starts, exact tool positions, step limits, ends by a done signal.

The rules are one tensor program, DeviceEpisodes: everything stays where the models are, in memory of fixed shape that
changes in place. The step of the world model's (DeviceEnvironment) waits for nothing and copies nothing up or down, so
that a GPU can run it as one captured graph. ImaginedEpisodes is its NumPy face, behind the Environment interface.

Shapes: N environments, M starts, H W 3 image, A action, P state.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.schema import RewardConfig
from wm_nodes.config.tasks import parts_of
from wm_nodes.core.cameras import CameraModel
from wm_nodes.core.device import explain_memory
from wm_nodes.core.seeding import stream_seed
from wm_nodes.core.specs import SOURCE_IMAGINED, EnvironmentSpec
from wm_nodes.core.tool_control import CommandedMove, check_actions
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.world_model.starts import starts_of


@dataclass(frozen=True)
class DeviceStep:
    """What one lock-step gives, as StepResult."""

    terminated_N: Tensor
    """bool (N,)."""
    truncated_N: Tensor
    """bool (N,)."""
    valid_N: Tensor
    """bool (N,)."""
    signal_N: Tensor
    """float32 (N,), the done signal."""
    uncertainty_N: Tensor
    """float32 (N,), >= 0."""


class DeviceEpisodes(ABC):
    """N imagined environments in lock-step, without the model that imagines. An episode terminates when the done signal
    exceeds reward.success_threshold (RS-7), and is truncated at the step limit or above reward.uncertainty_limit.

    reset() and step() are in place; resets are masks, ends are flags. Call them without gradients.

    Attributes:
        frames_NHWC: uint8. states_NP: float32. starts_N: int64, the start of each environment's episode.
        steps_N: int32, made in the episode.
        finite: bool (), False once the model has predicted NaN; while it is, no episode goes on. See check_finite.

    Args:
        spec: what imagined_spec gives.
        starts: frames and states.
        device: where the model is.
    """

    kind = "world model"

    def __init__(
        self, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig, device: torch.device
    ) -> None:
        self.spec, self.reward, self.device = spec, reward, device
        images, states = starts
        self.num_starts = len(images)
        self._start_frames = torch.from_numpy(images).to(device)
        self._start_states = torch.from_numpy(states).to(device, torch.float32)
        self._command = CommandedMove(spec, device)

    def begin_anew(self) -> None:
        """Take memory for a state of one's own, in which every episode has ended."""
        num_envs = self.spec.num_envs
        self.frames_NHWC = self._start_frames[:1].repeat(num_envs, 1, 1, 1)
        self.states_NP = self._start_states[:1].repeat(num_envs, 1)
        self.starts_N = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.steps_N = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        self._ended_N = torch.ones(num_envs, dtype=torch.bool, device=self.device)
        self.finite = torch.ones((), dtype=torch.bool, device=self.device)

    def reset(self, begins_N: Tensor, starts_N: Tensor) -> None:
        """Begin an episode at start starts_N (int64, below M) where begins_N is True."""
        self.starts_N.copy_(torch.where(begins_N, starts_N, self.starts_N))
        put_where(begins_N, self.frames_NHWC, self._start_frames[self.starts_N])
        put_where(begins_N, self.states_NP, self._start_states[self.starts_N])
        self._begin(begins_N)
        self.steps_N.masked_fill_(begins_N, 0)
        self._ended_N.masked_fill_(begins_N, False)

    def step(self, actions_NA: Tensor, noise: Tensor | None = None) -> DeviceStep:
        """Take one step with actions in [-1, 1] wherever the episode has not ended. noise: see ImaginedEpisodes."""
        valid = ~self._ended_N
        moved = self._move(actions_NA)
        frames, signal, spread = self._predict(actions_NA, moved, valid, noise)
        valid = valid & self.finite
        put_where(valid, self.frames_NHWC, frames)
        put_where(valid, self.states_NP, moved)
        self.steps_N.add_(valid)
        known = torch.ones_like(valid)
        if self.reward.uncertainty_limit > 0:
            known = spread <= self.reward.uncertainty_limit
        terminated = valid & known & (signal > self.reward.success_threshold)
        truncated = valid & ~terminated & (~known | (self.steps_N >= self.spec.max_episode_steps))
        self._ended_N.logical_or_(terminated | truncated)
        return DeviceStep(terminated, truncated, valid, signal, spread)

    def check_finite(self) -> None:
        """Raise FloatingPointError where the model has predicted NaN."""
        if not bool(self.finite):
            raise FloatingPointError(f"the {self.kind} predicted NaN; its weights are damaged or were trained too hot")

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        """Goal frame uint8 (M, H, W, 3) and found flag (M,) of every start, on the host; None without goals."""
        return None

    def _move(self, actions_NA: Tensor) -> Tensor:
        """States (N, P) that the actions command; measured values stay as they are."""
        return self._command(self.states_NP, actions_NA)

    @abstractmethod
    def _begin(self, begins_N: Tensor) -> None:
        """Let the environments where begins_N is True imagine from their start, self.starts_N."""

    @abstractmethod
    def _predict(
        self, actions_NA: Tensor, moved_NP: Tensor, valid_N: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Take the step where `valid`; return frames (N, H, W, 3), done signal (N,) and disagreement (N,)."""


class ImaginedEpisodes:
    """The NumPy face of imagined episodes. A reset with seed s begins at start s mod M, with the whole step limit.

    Args:
        seed: root of the stream `reset`, of which resets without seeds take theirs.
    """

    cameras: Sequence[CameraModel] = ()
    """Those whose pictures it imagines, where somebody has said so."""

    def __init__(self, episodes: DeviceEpisodes, *, seed: int) -> None:
        self.episodes, self.spec, self.device = episodes, episodes.spec, episodes.device
        self._seed, self._num_resets = seed, 0
        self._seeds = np.zeros(self.spec.num_envs, np.uint64)
        self._episode_ids = np.zeros(self.spec.num_envs, np.uint64)

    @torch.inference_mode()
    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        mask = np.ones(self.spec.num_envs, np.bool_) if mask is None else mask
        for i in np.flatnonzero(mask):
            self._num_resets += 1
            self._seeds[i] = stream_seed(self._seed, "reset", self._num_resets) if seeds is None else seeds[i]
            self._episode_ids[i] = self._num_resets
        starts = starts_of(self._seeds, self.episodes.num_starts)
        self.episodes.reset(self._tensor(mask), self._tensor(starts))
        return self.current()

    @torch.inference_mode()
    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        self.episodes.finite.fill_(True)
        with explain_memory(self.device, ppo__num_envs=self.spec.num_envs):
            made = self.episodes.step(self._tensor(actions), self._noise())
        self.episodes.check_finite()
        return StepResult(
            observation=self.current(),
            terminated=made.terminated_N.cpu().numpy(),
            truncated=made.truncated_N.cpu().numpy(),
            success_probability=made.signal_N.cpu().numpy(),
            uncertainty=made.uncertainty_N.cpu().numpy(),
            ground_truth=np.zeros((self.spec.num_envs, 0), np.float32),
            valid=made.valid_N.cpu().numpy(),
        )

    def current(self) -> Observation:
        frames, states = self.episodes.frames_NHWC.cpu().numpy(), self.episodes.states_NP.cpu().numpy()
        return Observation(frames.copy(), states.copy(), self._episode_ids.copy(), self._steps().astype(np.uint32))

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        if (goals := self.episodes.goals()) is None:
            return None
        starts = self.episodes.starts_N.cpu().numpy()
        return goals[0][starts], goals[1][starts]

    def close(self) -> None:
        return None

    def _noise(self) -> Tensor | None:
        """What the model needs for this step of numbers drawn on the host, each environment's from a stream of its
        episode's reset seed and step; None: nothing."""
        return None

    def _steps(self) -> NDArray[np.int32]:
        return self.episodes.steps_N.cpu().numpy()

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        """The array on the model's device."""
        return torch.from_numpy(array).to(self.device)


def put_where(mask_N: Tensor, now: Tensor, new: Tensor) -> None:
    """Put the rows of `new` where the mask is True into `now`, in place; both (N, ...), of one type. Rows are moved as
    the widest integers that fit: frames byte by byte took several percent of a step."""
    if not now.numel():  # no state values
        return
    row_bytes = now[0].numel() * now.element_size()
    wide = next(kind for kind in (torch.int64, torch.int32, torch.int16, torch.uint8) if not row_bytes % kind.itemsize)
    now, new = (rows.flatten(1).view(wide) for rows in (now, new.to(now.dtype)))
    torch.where(mask_N.unsqueeze(1), new, now, out=now)


def imagined_spec(spec: EnvironmentSpec, env_id: str, sha256: str, num_envs: int) -> EnvironmentSpec:
    """The spec of a simulator as that of a model, of files with this sha256, which stands in for it."""
    return replace(
        spec, env_id=env_id, source=SOURCE_IMAGINED, num_envs=num_envs, ground_truth_names=(),
        world_model_sha256=sha256,
    )


def task_indices(states: FloatArray, spec: EnvironmentSpec, index_of: Callable[[str], int]) -> NDArray[np.int64]:
    """(...,), the output of a world model for the task that each state (..., S) is of. index_of: its task_index."""
    indices = np.array([index_of(part) for part in parts_of(spec.task)], np.int64)
    codes = states[..., spec.tool_dim :]
    numbers = codes.argmax(-1) if codes.shape[-1] else np.zeros(states.shape[:-1], np.int64)
    return np.asarray(indices[numbers], np.int64)
