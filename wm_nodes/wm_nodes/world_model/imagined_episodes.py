"""What every imagined environment shares: real starts, exact tool positions, step limits, ends by a done signal.

A starts file holds frames and states of real episodes to imagine from, and may hold more about each of them.

Shapes: N environments, M starts, H W 3 image, A action, P state.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.schema import RewardConfig
from wm_nodes.config.tasks import parts_of, shares_scene
from wm_nodes.core.cameras import CameraModel
from wm_nodes.core.device import explain_memory
from wm_nodes.core.seeding import numpy_stream, stream_seed
from wm_nodes.core.specs import SOURCE_IMAGINED, EnvironmentSpec
from wm_nodes.core.tool_control import check_actions, next_commanded
from wm_nodes.core.types import BoolArray, Episode, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.training.checkpoint import read_tensors
from wm_nodes.world_model.text import instruction_for

STARTS_REMEDY = "copy the model folder again; one in a run folder is written again after it was deleted"
INSTRUCTIONS = "instructions"
"""Key of a starts file, see pack_instructions."""


def load_starts(path: Path, task: str = "") -> tuple[UInt8Array, FloatArray]:
    """Real frames uint8 (M, H, W, 3) and states float32 (M, P) to imagine from, those in the scene of `task`.

    Raises:
        ValueError: no such file, or none of its starts is in that scene.
    """
    tensors = read_tensors(path, STARTS_REMEDY)
    missing = {"images", "states"} - tensors.keys()
    if missing or not len(tensors["images"]):
        raise ValueError(f"{path} is no starts file: it must hold images and states of at least one first frame")
    rows = _rows(path, tensors, task)
    images, states = (tensors[name].numpy()[rows] for name in ("images", "states"))
    if not task or (parts := parts_of(task)) == (task,) or INSTRUCTIONS not in tensors:
        return images, states
    told = _told(path, tensors)
    own = [told[row][0] for row in rows]
    if task in own:  # its states say which task it is
        return images, states
    return images, np.concatenate([states, np.array([[part == one for part in parts] for one in own], np.float32)], 1)


def load_start_instructions(path: Path, spec: EnvironmentSpec) -> list[str]:
    """The instruction of every start of load_starts for the task of `spec`; that of the spec where the file has none.

    Raises:
        ValueError: as load_starts.
    """
    tensors = read_tensors(path, STARTS_REMEDY)
    rows = _rows(path, tensors, spec.task)
    if INSTRUCTIONS not in tensors:
        return [spec.instruction] * len(rows)
    told = _told(path, tensors)
    return [instruction_for(spec.task, *told[row], spec.instruction) for row in rows]


def _rows(path: Path, tensors: Mapping[str, Tensor], task: str) -> list[int]:
    """Numbers of the starts in the scene of `task`; all of them for "", or where it is not known what they are of."""
    rows = list(range(len(tensors["images"])))
    if not task or INSTRUCTIONS not in tensors:
        return rows
    told = _told(path, tensors)
    if found := [row for row in rows if shares_scene(told[row][0], task)]:
        return found
    raise ValueError(f"{path} has starts of {', '.join(sorted({own for own, _ in told}))}, none of {task}")


def _told(path: Path, tensors: Mapping[str, Tensor]) -> list[tuple[str, str]]:
    """(recorded task, instruction) of every start. Raises ValueError: not as many as there are starts."""
    told, count = json.loads(tensors[INSTRUCTIONS].numpy().tobytes()), len(tensors["images"])
    if len(told) != count:
        raise ValueError(f"{path} has {len(told)} instructions for {count} starts; delete it to have it written again")
    return [(task, own) for task, own in told]


def pack_instructions(episodes: Sequence[Episode]) -> Tensor:
    """The instructions of a starts file, uint8: the UTF-8 bytes of a JSON list of (recorded task, instruction)."""
    return _packed([(episode.task, episode.instruction) for episode in episodes])


def _packed(told: Sequence[tuple[str, str]]) -> Tensor:
    return torch.tensor(list(json.dumps(told).encode()), dtype=torch.uint8)


def join_starts(*paths: Path) -> dict[str, Tensor]:
    """The tensors of one starts file with the starts of several, without reset seeds.

    Raises:
        ValueError: a file without instructions.
    """
    files = [read_tensors(path, STARTS_REMEDY) for path in paths]
    for path, tensors in zip(paths, files, strict=True):
        if INSTRUCTIONS not in tensors:
            raise ValueError(f"{path} has no instructions; delete it to have it written again")
    told = [entry for path, tensors in zip(paths, files, strict=True) for entry in _told(path, tensors)]
    joined = {name: torch.cat([tensors[name] for tensors in files]) for name in ("images", "states")}
    return {**joined, INSTRUCTIONS: _packed(told)}


def load_start_seeds(path: Path, task: str = "") -> UInt64Array:
    """Reset seeds (M,) by which the simulator shows the first frames of load_starts.

    Raises:
        ValueError: a file without them: of an older version, or of frames in the middle of an episode.
    """
    tensors = read_tensors(path, STARTS_REMEDY)
    if "seeds" not in tensors:
        raise ValueError(f"{path} holds no reset seeds of first frames; delete it to have it written again, with "
                         "data.start_frames first")
    return np.asarray(tensors["seeds"].numpy()[_rows(path, tensors, task)], np.uint64)


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


def start_of(seed: int, num_starts: int) -> int:
    """The start at which a reset with `seed` begins."""
    return int(numpy_stream(seed, "start").integers(num_starts))


class ImaginedEpisodes(ABC):
    """N imagined environments in lock-step, without the model that imagines. An episode terminates when the done signal
    exceeds reward.success_threshold (RS-7), and is truncated at the step limit or above reward.uncertainty_limit.

    Args:
        spec: what imagined_spec gives.
        starts: frames and states; a reset with seed s begins at start hash(s) mod M, with the whole step limit.
        seed: root of the stream `reset`, of which resets without seeds take theirs.
        device: where the model is.
    """

    cameras: Sequence[CameraModel] = ()
    """Those whose pictures it imagines, where somebody has said so."""

    def __init__(
        self, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig, *, seed: int,
        device: torch.device,
    ) -> None:
        self.spec, self.starts, self.reward, self.device = spec, starts, reward, device
        images, states = starts
        self._seed, self._num_resets = seed, 0
        self._starts = np.zeros(spec.num_envs, np.int64)
        self._seeds = np.zeros(spec.num_envs, np.uint64)
        self._shown = np.repeat(images[:1], spec.num_envs, 0)
        self._states = np.repeat(states[:1], spec.num_envs, 0).astype(np.float32)
        self._steps = np.zeros(spec.num_envs, np.uint32)
        self._episode_ids = np.zeros(spec.num_envs, np.uint64)
        self._ended = np.ones(spec.num_envs, np.bool_)

    @torch.inference_mode()
    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        mask = np.ones(self.spec.num_envs, np.bool_) if mask is None else mask
        images, states = self.starts
        for i in np.flatnonzero(mask):
            self._num_resets += 1
            self._seeds[i] = stream_seed(self._seed, "reset", self._num_resets) if seeds is None else seeds[i]
            self._starts[i] = start_of(int(self._seeds[i]), len(images))
            self._episode_ids[i] = self._num_resets
        chosen = self._starts[mask]
        self._shown[mask] = images[chosen]
        self._states[mask] = states[chosen]
        self._begin(mask)
        self._steps[mask] = 0
        self._ended[mask] = False
        return self.current()

    @torch.inference_mode()
    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        valid = ~self._ended
        moved = self._move(actions)
        with explain_memory(self.device, ppo__num_envs=self.spec.num_envs):
            frames, signal, spread = self._predict(actions, moved, valid)
        self._states = np.where(valid[:, None], moved, self._states)
        self._steps += valid.astype(np.uint32)
        self._shown = np.where(valid[:, None, None, None], frames, self._shown)
        terminated = valid & (signal > self.reward.success_threshold)
        too_long = self._steps >= self.spec.max_episode_steps
        unsure = (self.reward.uncertainty_limit > 0) & (spread > self.reward.uncertainty_limit)
        truncated = valid & ~terminated & (too_long | unsure)
        self._ended = self._ended | terminated | truncated
        return StepResult(
            observation=self.current(),
            terminated=terminated,
            truncated=truncated,
            success_probability=signal,
            uncertainty=spread,
            ground_truth=np.zeros((self.spec.num_envs, 0), np.float32),
            valid=valid,
        )

    def current(self) -> Observation:
        return Observation(self._shown.copy(), self._states.copy(), self._episode_ids.copy(), self._steps.copy())

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        return None

    def _move(self, actions: FloatArray) -> FloatArray:
        """States (N, S) that the actions command; measured values stay as they are."""
        return next_commanded(self._states, actions, self.spec)

    @abstractmethod
    def _begin(self, mask: BoolArray) -> None:
        """Let the environments of `mask` imagine from their start, self._starts."""

    @abstractmethod
    def _predict(
        self, actions: FloatArray, moved: FloatArray, valid: BoolArray
    ) -> tuple[UInt8Array, FloatArray, FloatArray]:
        """Take the step where `valid`; return frames (N, H, W, 3), done signal (N,) and disagreement (N,)."""

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        """The array on the model's device."""
        return torch.from_numpy(array).to(self.device)
