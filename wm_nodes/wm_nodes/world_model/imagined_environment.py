"""The world model behind the Environment interface: the policy's training ground (RS-9).

Shapes: N environments, M starts, S tokens, D values per token, A action, P state.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor

from wm_nodes.config.schema import RewardConfig
from wm_nodes.core.cameras import CameraModel
from wm_nodes.core.device import explain_memory
from wm_nodes.core.seeding import numpy_stream, stream_seed
from wm_nodes.core.specs import SOURCE_IMAGINED, EnvironmentSpec
from wm_nodes.core.tool_control import check_actions, next_state
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.world_model.dynamics import ActionModel, done_signal
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.parts import in_parallel, parts_of
from wm_nodes.world_model.precision import compute_context, copy_in_bfloat16, has_fast_bfloat16
from wm_nodes.world_model.text import imagine_goals
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.transformer import RingCache, SpatioTemporalTransformer

GOAL_BATCH = 64

CachedPart = tuple[slice, list[RingCache]]
"""The rows of a part of the batch, and the history of their environments."""


def cached_parts(trunk: SpatioTemporalTransformer, batch: int, device: torch.device) -> list[CachedPart]:
    """The parts of a batch, each with caches that start empty."""
    return [(rows, trunk.new_ring_caches(rows.stop - rows.start, device)) for rows in parts_of(batch, device)]


def load_starts(path: Path) -> tuple[UInt8Array, FloatArray]:
    """Real first frames uint8 (M, H, W, 3) and states float32 (M, P) to imagine from."""
    tensors = load_file(path)
    missing = {"images", "states"} - tensors.keys()
    if missing or not len(tensors["images"]):
        raise ValueError(f"{path} is no starts file: it must hold images and states of at least one first frame")
    return tensors["images"].numpy(), tensors["states"].numpy()


def imagined_spec(models: WorldModels, spec: EnvironmentSpec, num_envs: int) -> EnvironmentSpec:
    """The spec of the simulator as that of `models`, which stand in for it."""
    return replace(
        spec, env_id=f"wm/{spec.task}", source=SOURCE_IMAGINED, num_envs=num_envs, ground_truth_names=(),
        world_model_sha256=models.sha256,
    )


def models_to_infer(models: WorldModels, *, exact: bool) -> tuple[Tokenizer, ActionModel | TokenActionModel]:
    """Tokenizer and action model with their weights cast once for compute_context; the same bits."""
    if not has_fast_bfloat16(models.tokenizer.device):
        return models.tokenizer, models.action
    return copy_in_bfloat16(models.tokenizer), models.action if exact else copy_in_bfloat16(models.action)


def encode_starts(models: WorldModels, images: UInt8Array) -> Tensor:
    """Latents (M, S, D) of first frames (M, H, W, 3)."""
    return torch.cat([models.tokenizer.encode(images[i : i + 256]) for i in range(0, len(images), 256)])


def start_of(seed: int, num_starts: int) -> int:
    """The start at which a reset with `seed` begins."""
    return int(numpy_stream(seed, "start").integers(num_starts))


def imagine_start_goals(
    models: WorldModels, images: UInt8Array, spec: EnvironmentSpec, reward: RewardConfig
) -> tuple[UInt8Array, BoolArray] | None:
    """Goal frame and found flag of every start: one per (first frame, instruction), so computed once; None without a
    text model."""
    if models.text is None:
        return None
    parts = [
        imagine_goals(
            models.text, models.tokenizer, images[i : i + GOAL_BATCH], spec.instruction, models.task_index(spec.task),
            horizon=spec.max_episode_steps, threshold=reward.goal_threshold,
        )
        for i in range(0, len(images), GOAL_BATCH)
    ]
    return np.concatenate([part.goals for part in parts]), np.concatenate([part.found for part in parts])


class ImaginedEnvironment:
    """N imagined environments in lock-step. An episode terminates when the done signal exceeds
    reward.success_threshold (RS-7), and is truncated at the step limit or above reward.uncertainty_limit.

    Args:
        spec: of the simulator the model was learned from; env_id, source and truth are replaced.
        starts: first frames and states; a reset with seed s begins at start hash(s) mod M.
        with_goals: imagine goals by the text model (needed for the dense reward).
        exact: compute in float32 even where bfloat16 is faster.
    """

    cameras: Sequence[CameraModel] = ()
    """Those whose pictures it imagines, where somebody has said so."""

    def __init__(
        self, models: WorldModels, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig,
        *, num_envs: int, seed: int = 0, with_goals: bool = True, exact: bool = False,
    ) -> None:
        self.spec = imagined_spec(models, spec, num_envs)
        self.models, self.reward, self.starts, self._exact = models, reward, starts, exact
        self._task = models.task_index(spec.task)
        self._tokenizer, self._action = models_to_infer(models, exact=exact)
        self._images, self._start_states = starts
        tokenizer = models.tokenizer
        self._start_latents = encode_starts(models, self._images)
        self._goals = imagine_start_goals(models, self._images, self.spec, reward) if with_goals else None
        self._seed, self._num_resets = seed, 0
        self._parts = cached_parts(models.action.trunk, num_envs, tokenizer.device)
        self._latents = self._start_latents[:1].repeat(num_envs, 1, 1)
        self._starts = np.zeros(num_envs, np.int64)
        self._shown = np.repeat(self._images[:1], num_envs, 0)
        self._states = np.repeat(self._start_states[:1], num_envs, 0).astype(np.float32)
        self._steps = np.zeros(num_envs, np.uint32)
        self._episode_ids = np.zeros(num_envs, np.uint64)
        self._ended = np.ones(num_envs, np.bool_)

    @torch.inference_mode()
    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        mask = np.ones(self.spec.num_envs, np.bool_) if mask is None else mask
        for i in np.flatnonzero(mask):
            self._num_resets += 1
            seed = stream_seed(self._seed, "reset", self._num_resets) if seeds is None else int(seeds[i])
            self._starts[i] = start_of(seed, len(self._images))
            self._episode_ids[i] = self._num_resets
        chosen = self._starts[mask]
        self._shown[mask] = self._images[chosen]
        self._states[mask] = self._start_states[chosen]
        begins, first = self._tensor(mask), self._start_latents[self._tensor(self._starts)]
        self._latents = torch.where(begins[:, None, None], first, self._latents)
        for rows, caches in self._parts:
            caches[0].restart(begins[rows])
        self._steps[mask] = 0
        self._ended[mask] = False
        return self.current()

    @torch.inference_mode()
    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        valid = ~self._ended
        moved = next_state(self._states, actions, self.spec)
        with explain_memory(self.models.tokenizer.device, ppo__num_envs=self.spec.num_envs):
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
        if self._goals is None:
            return None
        frames, found = self._goals
        return frames[self._starts], found[self._starts]

    def close(self) -> None:
        return None

    def _predict(
        self, actions: FloatArray, moved: FloatArray, valid: BoolArray
    ) -> tuple[UInt8Array, FloatArray, FloatArray]:
        """Take the step where `valid`; return frames (N, H, W, 3), done signal (N,) and disagreement (N,)."""
        tokenizer, model = self._tokenizer, self._action
        acted, before, after = (self._tensor(array) for array in (actions, self._states, moved))
        keep = self._tensor(valid)[:, None, None]

        def part(item: CachedPart) -> tuple[Tensor, Tensor, Tensor]:
            rows, caches = item
            with compute_context(tokenizer.device, exact=self._exact):
                latents, logits = model.advance(self._latents[rows], acted[rows], before[rows], after[rows], caches)
            latents = torch.where(keep[rows], latents, self._latents[rows])
            return latents, logits, tokenizer.decode(latents)

        parts = in_parallel(part, self._parts)
        latents, logits, frames = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
        if not torch.isfinite(latents).all():
            raise FloatingPointError("the world model predicted NaN; its weights are damaged or were trained too hot")
        self._latents = latents
        signal, spread = done_signal(logits)
        told = torch.stack((signal[:, self._task], spread[:, self._task])).cpu()
        return frames.cpu().numpy(), told[0].numpy(), told[1].numpy()

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        """The array on the models' device."""
        return torch.from_numpy(array).to(self.models.tokenizer.device)
