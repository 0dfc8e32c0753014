"""The world model behind the Environment interface: the policy's training ground (RS-9).

Shapes: N environments, M starts, S tokens, D values per token, A action, P state.
"""

from collections.abc import Callable, Sequence

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


class ModelRollouts:
    """What one action model imagines for N environments; latents: (N, S, D), of the newest frames.

    Args:
        model: as models_to_infer casts it.
    """

    def __init__(self, model: ActionModel | TokenActionModel, latents: Tensor, *, exact: bool) -> None:
        self.latents, self._model, self._exact = latents, model, exact
        self._parts = cached_parts(model.trunk, len(latents), latents.device)

    def begin(self, begins: Tensor, first: Tensor) -> None:
        """Begin an episode at latents `first` (N, S, D) where `begins` (N,)."""
        self.latents = torch.where(begins[:, None, None], first, self.latents)
        for rows, caches in self._parts:
            caches[0].restart(begins[rows])

    def next_states(self, acted: Tensor, before: Tensor, commanded: Tensor) -> Tensor:
        """The states (N, P) that a step reaches, the measured values as the model predicts them."""
        assert self._model.state_change is not None
        with compute_context(self.latents.device, exact=self._exact):
            return self._model.state_change.next_states(self.latents, acted, before, commanded)

    def step(
        self, acted: Tensor, before: Tensor, after: Tensor, valid: Tensor, show: Callable[[Tensor, slice], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Take the step where `valid`; return the logits of the done heads and show(latents of some rows, rows).

        Raises:
            FloatingPointError: a latent is NaN.
        """
        keep = valid[:, None, None]

        def part(item: CachedPart) -> tuple[Tensor, Tensor, Tensor]:
            rows, caches = item
            with compute_context(self.latents.device, exact=self._exact):
                latents, logits = self._model.advance(
                    self.latents[rows], acted[rows], before[rows], after[rows], caches
                )
            latents = torch.where(keep[rows], latents, self.latents[rows])
            return latents, logits, show(latents, rows)

        parts = in_parallel(part, self._parts)
        latents, logits, shown = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
        if not torch.isfinite(latents).all():
            raise FloatingPointError("the world model predicted NaN; its weights are damaged or were trained too hot")
        self.latents = latents
        return logits, shown


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
        second: another model of the same tokenizer and tasks; the lower done signal of both counts, and their
            difference as disagreement.

    Raises:
        ValueError: a second model with another tokenizer, or with other tasks.
    """

    def __init__(
        self, models: WorldModels, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig,
        *, num_envs: int, seed: int = 0, instructions: Sequence[str] = (), with_goals: bool = True,
        exact: bool = False, picture_noise: float = 0.0, second: WorldModels | None = None,
    ) -> None:
        super().__init__(
            world_model_spec(models, spec, num_envs), starts, reward, seed=seed, device=models.tokenizer.device
        )
        self.models, self.instructions, self._exact = models, instructions, exact
        self.picture_noise, self.second = picture_noise, second
        if second and (second.tokenizer_sha256, second.tasks) != (models.tokenizer_sha256, models.tasks):
            raise ValueError(
                "imagined_environment.second_model has another tokenizer or other tasks than the world model; refresh "
                "that model (model_refresh.num_rounds), or leave it empty"
            )
        self._start_tasks = task_indices(starts[1], spec, models.task_index)
        self._tokenizer, action = models_to_infer(models, exact=exact)
        images, _ = starts
        self._start_latents = encode_starts(models, images)
        self._goals = imagine_start_goals(models, starts, self.spec, reward, instructions) if with_goals else None
        first = self._start_latents[:1].repeat(num_envs, 1, 1)
        actions = [action, *([models_to_infer(second, exact=exact)[1]] if second else [])]
        self._rollouts = [ModelRollouts(model, first, exact=exact) for model in actions]

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        if self._goals is None:
            return None
        frames, found = self._goals
        return frames[self._starts], found[self._starts]

    def _begin(self, mask: BoolArray) -> None:
        begins, first = self._tensor(mask), self._start_latents[self._tensor(self._starts)]
        for rollouts in self._rollouts:
            rollouts.begin(begins, first)

    def _move(self, actions: FloatArray) -> FloatArray:
        moved, tool = super()._move(actions), self.spec.tool_dim
        if self.spec.measured:
            inputs = map(self._tensor, (actions, self._states[:, :tool], moved[:, :tool]))
            moved[:, :tool] = self._rollouts[0].next_states(*inputs).cpu().numpy()
        return moved

    def _predict(
        self, actions: FloatArray, moved: FloatArray, valid: BoolArray
    ) -> tuple[UInt8Array, FloatArray, FloatArray]:
        tool, noise = self.spec.tool_dim, self._noise()
        acted, before, after = map(self._tensor, (actions, self._states[:, :tool], moved[:, :tool]))
        inputs = acted, before, after, self._tensor(valid)
        tasks = self._tensor(self._start_tasks[self._starts])

        def show(latents: Tensor, rows: slice) -> Tensor:
            return self._tokenizer.decode(latents if noise is None else latents + noise[rows])

        logits, frames = self._rollouts[0].step(*inputs, show)
        signal, spread = task_done_signal(logits, tasks)
        for rollouts in self._rollouts[1:]:
            logits, _ = rollouts.step(*inputs, lambda latents, rows: latents[:0])
            other, other_spread = task_done_signal(logits, tasks)
            spread = torch.stack([spread, other_spread, (signal - other).abs()]).amax(0)
            signal = torch.minimum(signal, other)
        told = torch.stack((signal, spread)).cpu()
        return frames.cpu().numpy(), told[0].numpy(), told[1].numpy()

    def _noise(self) -> Tensor | None:
        """Noise on the shown latents (N, S, D) at this step; None without."""
        if not self.picture_noise:
            return None
        streams = (
            torch_stream(int(seed), "picture_noise", env, int(step))
            for env, (seed, step) in enumerate(zip(self._seeds, self._steps, strict=True))
        )
        drawn = torch.stack([torch.randn(self._start_latents.shape[1:], generator=stream) for stream in streams])
        return self.picture_noise * drawn.to(self.device)
