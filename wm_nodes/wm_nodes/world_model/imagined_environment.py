"""The world model behind the Environment interface: the policy's training ground (RS-9).

Shapes: N environments, M starts, S tokens, D values per token, A action, P state.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.schema import RewardConfig
from wm_nodes.core.seeding import torch_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.world_model.dynamics import ActionModel, task_done_signal
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.imagined_episodes import ImaginedEpisodes, imagined_spec, task_indices
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


def world_model_spec(models: WorldModels, spec: EnvironmentSpec, num_envs: int) -> EnvironmentSpec:
    """The spec of the simulator as that of `models`, which stand in for it."""
    return imagined_spec(spec, f"wm/{spec.task}", models.sha256, num_envs)


def models_to_infer(models: WorldModels, *, exact: bool) -> tuple[Tokenizer, ActionModel | TokenActionModel]:
    """Tokenizer and action model with their weights cast once for compute_context; the same bits."""
    if not has_fast_bfloat16(models.tokenizer.device):
        return models.tokenizer, models.action
    return copy_in_bfloat16(models.tokenizer), models.action if exact else copy_in_bfloat16(models.action)


def encode_starts(models: WorldModels, images: UInt8Array) -> Tensor:
    """Latents (M, S, D) of first frames (M, H, W, 3)."""
    return torch.cat([models.tokenizer.encode(images[i : i + 256]) for i in range(0, len(images), 256)])


def imagine_start_goals(
    models: WorldModels, starts: tuple[UInt8Array, FloatArray], spec: EnvironmentSpec, reward: RewardConfig,
    instructions: Sequence[str] = (),
) -> tuple[UInt8Array, BoolArray] | None:
    """Goal frame and found flag of every start: one per (frame, instruction), so computed once; None without a text
    model. instructions: of every start; none: that of the spec."""
    if models.text is None:
        return None
    images, states = starts
    tasks = task_indices(states, spec, models.task_index).tolist()
    texts = instructions or [spec.instruction] * len(images)
    parts = [
        imagine_goals(
            models.text, models.tokenizer, images[i : i + GOAL_BATCH], texts[i : i + GOAL_BATCH],
            tasks[i : i + GOAL_BATCH], horizon=spec.max_episode_steps, threshold=reward.goal_threshold,
        )
        for i in range(0, len(images), GOAL_BATCH)
    ]
    return np.concatenate([part.goals for part in parts]), np.concatenate([part.found for part in parts])


class ImaginedEnvironment(ImaginedEpisodes):
    """N imagined environments in lock-step. An episode terminates when the done signal exceeds
    reward.success_threshold (RS-7), and is truncated at the step limit or above reward.uncertainty_limit.

    Args:
        spec, starts, reward: as ImaginedEpisodes's; the spec is that of the simulator the model was learned from.
        instructions: of every start, for its goal; none: that of the spec.
        with_goals: imagine goals by the text model (needed for the dense reward).
        exact: compute in float32 even where bfloat16 is faster.
        picture_noise: standard deviation of noise on the latents of shown frames, of the stream picture_noise of
            (episode's reset seed, environment, step); the model goes on without it.
    """

    def __init__(
        self, models: WorldModels, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig,
        *, num_envs: int, seed: int = 0, instructions: Sequence[str] = (), with_goals: bool = True,
        exact: bool = False, picture_noise: float = 0.0,
    ) -> None:
        super().__init__(
            world_model_spec(models, spec, num_envs), starts, reward, seed=seed, device=models.tokenizer.device
        )
        self.models, self.instructions, self._exact = models, instructions, exact
        self.picture_noise = picture_noise
        self._start_tasks = task_indices(starts[1], spec, models.task_index)
        self._tokenizer, self._action = models_to_infer(models, exact=exact)
        images, _ = starts
        self._start_latents = encode_starts(models, images)
        self._goals = imagine_start_goals(models, starts, self.spec, reward, instructions) if with_goals else None
        self._parts = cached_parts(models.action.trunk, num_envs, self.device)
        self._latents = self._start_latents[:1].repeat(num_envs, 1, 1)

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        if self._goals is None:
            return None
        frames, found = self._goals
        return frames[self._starts], found[self._starts]

    def _begin(self, mask: BoolArray) -> None:
        begins, first = self._tensor(mask), self._start_latents[self._tensor(self._starts)]
        self._latents = torch.where(begins[:, None, None], first, self._latents)
        for rows, caches in self._parts:
            caches[0].restart(begins[rows])

    def _predict(
        self, actions: FloatArray, moved: FloatArray, valid: BoolArray
    ) -> tuple[UInt8Array, FloatArray, FloatArray]:
        tokenizer, model = self._tokenizer, self._action
        tool = self.spec.tool_dim
        acted, before, after = map(self._tensor, (actions, self._states[:, :tool], moved[:, :tool]))
        keep = self._tensor(valid)[:, None, None]
        noise = self._noise()

        def part(item: CachedPart) -> tuple[Tensor, Tensor, Tensor]:
            rows, caches = item
            with compute_context(tokenizer.device, exact=self._exact):
                latents, logits = model.advance(self._latents[rows], acted[rows], before[rows], after[rows], caches)
            latents = torch.where(keep[rows], latents, self._latents[rows])
            return latents, logits, tokenizer.decode(latents if noise is None else latents + noise[rows])

        parts = in_parallel(part, self._parts)
        latents, logits, frames = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
        if not torch.isfinite(latents).all():
            raise FloatingPointError("the world model predicted NaN; its weights are damaged or were trained too hot")
        self._latents = latents
        told = torch.stack(task_done_signal(logits, self._tensor(self._start_tasks[self._starts]))).cpu()
        return frames.cpu().numpy(), told[0].numpy(), told[1].numpy()

    def _noise(self) -> Tensor | None:
        """Noise on the shown latents (N, S, D) at this step; None without."""
        if not self.picture_noise:
            return None
        streams = (
            torch_stream(int(seed), "picture_noise", env, int(step))
            for env, (seed, step) in enumerate(zip(self._seeds, self._steps, strict=True))
        )
        drawn = torch.stack([torch.randn(self._latents.shape[1:], generator=stream) for stream in streams])
        return self.picture_noise * drawn.to(self.device)
