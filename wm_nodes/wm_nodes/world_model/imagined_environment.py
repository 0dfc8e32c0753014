"""The world model as the policy's training ground (RS-9): a device program, and its face behind the Environment
interface.

Shapes: N environments, M starts, S tokens, D values per token, A action, P state, H W 3 image.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.schema import PolicyInputs, RewardConfig
from wm_nodes.core.seeding import torch_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.world_model.dynamics import ActionModel, task_done_signal
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.imagined_episodes import (
    DeviceEpisodes,
    ImaginedEpisodes,
    imagined_spec,
    put_where,
    task_indices,
)
from wm_nodes.world_model.parts import in_parallel, parts_of
from wm_nodes.world_model.precision import copy_in_bfloat16, has_fast_bfloat16
from wm_nodes.world_model.state_model import next_states
from wm_nodes.world_model.text import ImaginedGoals, imagine_goals
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.transformer import RingCache, SpatioTemporalTransformer

GOAL_BATCH = 64

CachedPart = tuple[slice, list[RingCache]]
"""The rows of a part of the batch, and the history of their environments."""


def cached_parts(
    trunk: SpatioTemporalTransformer, batch: int, device: torch.device, *, fixed: bool | None = None
) -> list[CachedPart]:
    """The parts of a batch, each with caches that start empty. fixed: see RingTimes."""
    return [
        (rows, trunk.new_ring_caches(rows.stop - rows.start, device, fixed=fixed)) for rows in parts_of(batch, device)
    ]


def imagine_start_goals(
    models: WorldModels, starts: tuple[UInt8Array, FloatArray], spec: EnvironmentSpec, reward: RewardConfig,
    instructions: Sequence[str] = (),
) -> ImaginedGoals | None:
    """The golden trajectory of every start: one per (frame, instruction), so computed once; None without a text model.
    instructions: of every start; none: that of the spec."""
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
    return ImaginedGoals(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("frames", "lengths", "found"))
    )


@dataclass(frozen=True)
class ImaginedLatents:
    """What one action model imagines, changed in place."""

    model: ActionModel | TokenActionModel
    """With its weights cast once for the type that it computes in."""
    latents_NSD: Tensor
    """float32, of the newest frames."""
    parts: list[CachedPart]
    """On a CPU a thread computes each; see parts.py."""


class DeviceEnvironment(DeviceEpisodes):
    """N imagined environments on the models' device.

    Args:
        spec, starts, reward: as DeviceEpisodes's; the spec is that of the simulator the model was learned from.
        instructions: of every start, for its goal; none: that of the spec.
        with_goals: imagine goals by the text model (needed for the dense reward).
        exact: compute in float32 even where bfloat16 is faster.
        second: another model of the same tokenizer and tasks; the lower done signal of both counts, and their
            difference as disagreement.
        fixed: see RingTimes; by default on all devices but the CPU.

    Attributes:
        pictures: False leaves the frames those of the start. Nothing else differs where every model has a state_model;
            elsewhere it may not be set.

    Raises:
        ValueError: a second model with another tokenizer, with other tasks, or of measured states, which the first
            alone moves.
    """

    def __init__(
        self, models: WorldModels, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig,
        *, num_envs: int, instructions: Sequence[str] = (), with_goals: bool = True, exact: bool = False,
        second: WorldModels | None = None, fixed: bool | None = None,
    ) -> None:
        device, self.pictures = models.tokenizer.device, True
        super().__init__(imagined_spec(spec, f"wm/{spec.task}", models.sha256, num_envs), starts, reward, device)
        if second and (second.tokenizer_sha256, second.tasks) != (models.tokenizer_sha256, models.tasks):
            raise ValueError(
                "imagined_environment.second_model has another tokenizer or other tasks than the world model; refresh "
                "that model (model_refresh.num_rounds), or leave it empty"
            )
        if second and spec.measured:
            raise ValueError(f"imagined_environment.second_model predicts pictures, and {spec.task} has places in its "
                             "state, which the world model alone predicts; leave it empty")
        self.tokenizer_sha256 = models.tokenizer_sha256
        self._fast, self._exact, self._fixed = has_fast_bfloat16(device), exact, fixed
        self._tokenizer = copy_in_bfloat16(models.tokenizer) if self._fast else models.tokenizer
        self._models = [
            copy_in_bfloat16(each.action) if self._fast and not exact else each.action
            for each in (models, *([second] if second else []))
        ]
        images, states = starts
        self._start_latents = torch.cat(
            [models.tokenizer.encode(images[i : i + 256]) for i in range(0, len(images), 256)]
        ).clone()
        self._start_tasks = torch.from_numpy(task_indices(states, spec, models.task_index)).to(device)
        found = imagine_start_goals(models, starts, self.spec, reward, instructions) if with_goals else None
        self._goals = None if found is None else (found.goals, found.found)
        self.golden = found if reward.mode == "progress" else None
        """The golden trajectory of every start, on the host; only the progress mode reads it."""
        self.begin_anew()

    def begin_anew(self) -> None:
        super().begin_anew()
        num_envs = self.spec.num_envs
        self._earlier_NP = self.states_NP[:, : self.spec.tool_dim].clone()
        self.imagined = [
            ImaginedLatents(
                model, self._start_latents[:1].repeat(num_envs, 1, 1),
                cached_parts(model.trunk, num_envs, self.device, fixed=self._fixed),
            )
            for model in self._models
        ]

    @classmethod
    def beside(cls, environment: "ImaginedEnvironment") -> "DeviceEnvironment":
        """The same models, starts, rules and number of environments, with a state of its own.

        Raises:
            ValueError: an environment with picture noise.
        """
        if environment.picture_noise:
            raise ValueError(
                "device rollouts know no imagined_environment.picture_noise; leave it unset, or leave the rollouts to "
                "the graph"
            )
        program = copy.copy(environment.episodes)
        program.begin_anew()
        return program

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return self._goals

    def encode(self, inputs: PolicyInputs = "latents") -> Tensor:
        """Features (N, F) float32 of the frames shown for a policy: Tokenizer.flatten of Tokenizer.encode."""
        if inputs == "state":
            return self.states_NP[:, :0]
        with self._autocast():
            latents = self._tokenizer.bottleneck(
                self._tokenizer.features(self.frames_NHWC.permute(0, 3, 1, 2).float() / 255)
            )
            return self._tokenizer.flatten(latents, inputs)

    @property
    def is_told(self) -> bool:
        """Whether states alone say what happens, see pictures."""
        return all(model.state_model is not None for model in self._models)

    def _begin(self, begins_N: Tensor) -> None:
        put_where(begins_N, self._earlier_NP, self._start_states[self.starts_N, : self.spec.tool_dim])
        for imagined in self.imagined:
            put_where(begins_N, imagined.latents_NSD, self._start_latents[self.starts_N])
            for rows, caches in imagined.parts:
                caches[0].restart(begins_N[rows])

    def _move(self, actions_NA: Tensor) -> Tensor:
        moved, tool = super()._move(actions_NA), self.spec.tool_dim
        if not self.spec.measured:
            return moved
        now, latents = self.states_NP[:, :tool].contiguous(), self.imagined[0].latents_NSD
        with self._autocast(exact=self._exact):
            found = next_states(self._models[0], latents, actions_NA, now, self._earlier_NP, moved[:, :tool])
        self.finite.logical_and_(torch.isfinite(found).all())
        put_where(~self._ended_N, self._earlier_NP, now)
        return torch.cat([found, moved[:, tool:]], 1)

    def _predict(
        self, actions_NA: Tensor, moved_NP: Tensor, valid_N: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """noise: (N, S, D), on the latents of the shown frames; the model goes on without it."""
        tasks = self._start_tasks[self.starts_N]
        if not self.pictures:
            return self.frames_NHWC, *self._agreed([self._told(model, moved_NP) for model in self._models], tasks)

        def show(latents: Tensor, rows: slice) -> Tensor:
            with self._autocast():
                return self._tokenizer.decode_part(latents if noise is None else latents + noise[rows])

        logits, frames = self._advance(self.imagined[0], actions_NA, moved_NP, valid_N, show)
        others = [
            self._advance(rival, actions_NA, moved_NP, valid_N, lambda latents, rows: latents[:0])[0]
            for rival in self.imagined[1:]
        ]
        return frames, *self._agreed([logits, *others], tasks)

    def _told(self, model: ActionModel | TokenActionModel, moved_NP: Tensor) -> Tensor:
        """Done logits (N, K, J) by the states alone."""
        assert model.state_model is not None  # see pictures
        moved, before = (states[:, : self.spec.tool_dim] for states in (moved_NP, self.states_NP))
        return model.state_model.done_logits(moved, before)

    @staticmethod
    def _agreed(logits: Sequence[Tensor], tasks_N: Tensor) -> tuple[Tensor, Tensor]:
        """The done signal (N,) that all models agree on, and how far they and their heads differ (N,)."""
        signal, spread = task_done_signal(logits[0], tasks_N)
        for rival in logits[1:]:
            other, other_spread = task_done_signal(rival, tasks_N)
            spread = torch.stack([spread, other_spread, (signal - other).abs()]).amax(0)
            signal = torch.minimum(signal, other)
        return signal, spread

    def _advance(
        self, imagined: ImaginedLatents, actions_NA: Tensor, moved_NP: Tensor, valid_N: Tensor,
        show: Callable[[Tensor, slice], Tensor],
    ) -> tuple[Tensor, Tensor]:
        """Imagine the next latents; return the logits of the done heads, and show(latents of some rows, rows)."""
        before, after = (states[:, : self.spec.tool_dim] for states in (self.states_NP, moved_NP))

        def part(item: CachedPart) -> tuple[Tensor, Tensor, Tensor]:
            rows, caches = item
            now = imagined.latents_NSD[rows]
            with self._autocast(exact=self._exact):
                latents, logits = imagined.model.advance(now, actions_NA[rows], before[rows], after[rows], caches)
            latents = torch.where(valid_N[rows, None, None], latents, now)
            return latents, logits, show(latents, rows)

        parts = imagined.parts
        results = [part(parts[0])] if len(parts) == 1 else in_parallel(part, parts)
        latents, logits, shown = results[0] if len(parts) == 1 else (torch.cat(pieces) for pieces in zip(*results))
        self.finite.logical_and_(torch.isfinite(latents).all())
        imagined.latents_NSD.copy_(torch.where(self.finite, latents, imagined.latents_NSD))
        return logits, shown

    def _autocast(self, *, exact: bool = False) -> torch.autocast:
        """As compute_context; the device was asked once. A captured graph cannot keep a cache of casts."""
        enabled = self._fast and not exact
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled, cache_enabled=False)


class ImaginedEnvironment(ImaginedEpisodes):
    """The NumPy face of a DeviceEnvironment, with its arguments.

    Args:
        seed: as ImaginedEpisodes's.
        picture_noise: standard deviation of noise on the latents of shown frames, of the stream picture_noise of
            (episode's reset seed, environment, step); the model goes on without it.
    """

    episodes: DeviceEnvironment

    def __init__(
        self, models: WorldModels, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig,
        *, num_envs: int, seed: int = 0, instructions: Sequence[str] = (), with_goals: bool = True,
        exact: bool = False, picture_noise: float = 0.0, second: WorldModels | None = None,
    ) -> None:
        episodes = DeviceEnvironment(
            models, spec, starts, reward, num_envs=num_envs, instructions=instructions, with_goals=with_goals,
            exact=exact, second=second,
        )
        super().__init__(episodes, seed=seed)
        self.picture_noise = picture_noise

    def _noise(self) -> Tensor | None:
        if not self.picture_noise:
            return None
        streams = (
            torch_stream(int(seed), "picture_noise", env, int(step))
            for env, (seed, step) in enumerate(zip(self._seeds, self._steps(), strict=True))
        )
        shape = self.episodes.imagined[0].latents_NSD.shape[1:]
        drawn = torch.stack([torch.randn(shape, generator=stream) for stream in streams])
        return self.picture_noise * drawn.to(self.device)
