"""GRPO of a flow-matching video model on a rollout buffer, equations (13) to (18), (20).

Shapes: N videos, S stochastic steps, M transitions (video, step) of one network call, U generated elements.

One buffer serves `updates_per_buffer` optimizer steps. Each one accumulates over every kept (video, step) pair, divided
by their number, so that micro-batches and ranks do not change it. On the first one the ratio is 1 and the KL of (20) 0.
"""

import copy
import json
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_

from wm_nodes.learning.checkpoint_tensors import metadata_of, optimizer_tensors, restore_optimizer, section
from wm_nodes.learning.distributed import Ranks
from wm_nodes.learning.files import write_atomic
from wm_nodes.learning.weights import check_same_layout
from wm_nodes.rl.group_advantages import GroupAdvantages, RunningStd, StdScope, best_of_n, group_advantages
from wm_nodes.rl.grpo import (
    KlMode,
    LogprobWeight,
    clip_tails,
    clipped_objective,
    gaussian_logprob,
    log_ratio,
    log_space_kl,
    mean_kl,
    normalised_log_ratio,
    step_equaliser,
    velocity_kl,
)
from wm_nodes.video_model.buffer import RolloutBuffer
from wm_nodes.video_model.kernels import masked_deviation
from wm_nodes.video_model.sampling import RolloutSettings, step_noise
from wm_nodes.video_model.step_window import select_steps
from wm_nodes.video_model.transitions import MaskSource, Transition, transition

Anchor = Literal["buffer", "frozen", "lora_off", "moving", "dual"]


@dataclass(frozen=True)
class AdvantageSettings:
    """(13). clip: of the normalised advantage. best_of_n: videos of a group that train, best and worst; 0: all."""

    clip: float = 2.5
    std_scope: StdScope = "group"
    ddof: int = 0
    best_of_n: int = 0


@dataclass(frozen=True)
class KlSettings:
    """(17), (20). beta: weight. anchor: buffer (what sampled), frozen (the model as it was at the start), lora_off (the
    same through switching the adapter off), moving (weights of every `moving_updates`-th update), dual (buffer always,
    frozen on every `dual_every`-th update beside it).
    """

    mode: KlMode = "mean"
    beta: float = 0.5
    anchor: Anchor = "buffer"
    moving_updates: int = 10
    dual_every: int = 4


@dataclass(frozen=True)
class GrpoSettings:
    """Everything of the update; lengths and limits as in DynDiff-GRPO's Table 5 where it gives them.

    updates_per_buffer: N_KL, optimizer steps on one buffer; passes: each on the whole buffer (full), or on its own
    part of the videos (parts). step_fraction, step_select, min_s: see step_window.select_steps. cfg: guidance of the
    training pass. ratio_norm: (15b). equalise: weigh steps by SAGE's equaliser. max_staleness: optimizer steps between
    sampling and training that are still accepted.
    """

    advantage: AdvantageSettings = field(default_factory=AdvantageSettings)
    kl: KlSettings = field(default_factory=KlSettings)
    clip_low: float = 1e-4
    clip_high: float = 1e-4
    logprob_weight: LogprobWeight = "full"
    mask_source: MaskSource = "cached"
    ratio_norm: bool = False
    equalise: bool = False
    updates_per_buffer: int = 2
    passes: Literal["full", "parts"] = "full"
    step_fraction: float = 0.55
    step_select: Literal["random", "first", "tmin"] = "random"
    min_s: float = 0.02
    cfg: float = 1.0
    micro_batch: int = 32
    learning_rate: float = 2e-6
    weight_decay: float = 0.01
    max_grad_norm: float = 1.0
    ema_decay: float = 0.0
    max_staleness: int = 0


@dataclass(frozen=True)
class UpdateReport:
    """One optimizer step; see docs/metrics.md. clip_low_share, clip_high_share: of transitions, by tail.

    *_seconds: forward with backward of the weights that train; the anchor's forward and the KL.
    """

    objective: float
    kl: float
    ratio_mean: float
    clip_low_share: float
    clip_high_share: float
    grad_norm: float
    transitions: int
    train_seconds: float
    kl_seconds: float


@dataclass(frozen=True)
class BufferReport:
    """What one buffer gave. updates: one report per optimizer step, in order (index 0 is on-policy)."""

    updates: tuple[UpdateReport, ...]
    reward_mean: float
    advantage_abs_mean: float
    zero_std_ratio: float
    invalid: int
    kept: int
    group_size: float
    noise_share: float


@dataclass(frozen=True)
class _Row:
    """One optimizer step's transitions: videos and positions among the stochastic steps, (M,)."""

    videos: Tensor
    positions: Tensor


class GrpoLearner:
    """Trains `model` in place.

    Args:
        seed: of the step selection (stream `step_selection`).
        ranks: this process's place among the learner's processes; all hold the whole buffer.
    """

    def __init__(
        self,
        model: nn.Module,
        settings: GrpoSettings,
        rollout: RolloutSettings,
        *,
        seed: int,
        ranks: Ranks | None = None,
    ) -> None:
        if rollout.sampler.arm == "ode" or rollout.sampler.eta == 0:
            raise ValueError("an ODE rollout has no likelihood to train on; choose a stochastic arm and eta > 0")
        self.model, self.settings, self.rollout, self.seed = model, settings, rollout, seed
        self.ranks = ranks or Ranks()
        self.version = 0
        """Optimizer steps made so far: the policy version of the weights."""
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        self._optimizer = torch.optim.AdamW(
            self.parameters, lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self._running = RunningStd()
        self._anchor = (
            copy.deepcopy(model).requires_grad_(False) if settings.kl.anchor in ("frozen", "moving", "dual") else None
        )
        self._anchor_moves = settings.kl.anchor == "moving"
        self.averaged = {name: p.detach().clone() for name, p in _trained(model)} if settings.ema_decay > 0 else {}

    def train(self, buffer: RolloutBuffer) -> BufferReport:
        """Make `updates_per_buffer` optimizer steps; nothing has changed when it raises.

        Raises:
            RolloutBufferError: another sampler configuration, or a stale buffer.
            ValueError: no video that can train (every reward invalid or every group without spread), or no generated
                frame.
            FloatingPointError: a loss or gradient is not finite.
        """
        buffer.check(self.rollout, self.version, self.settings.max_staleness)
        if buffer.condition.num_conditioning >= buffer.rollout.latents.shape[2]:
            raise ValueError(
                f"all {buffer.rollout.latents.shape[2]} frames of these videos are given: nothing was generated that "
                f"could be learned from; give fewer"
            )
        rewards, before = mixed_reward(buffer), self._snapshot()
        advantages = self._advantages(rewards, buffer)
        kept = best_of_n(
            advantages.advantages_N, buffer.group_ids, advantages.kept_N, self.settings.advantage.best_of_n
        )
        if not bool(kept.any()):
            raise ValueError(
                f"nothing to learn from: {advantages.num_invalid} of {len(buffer)} rewards are invalid and "
                f"{advantages.num_zero_std} of {advantages.num_groups} groups have no spread; look at the reward"
            )
        try:
            updates = tuple(self._update(buffer, rows, advantages) for rows in self._passes(buffer, kept))
        except BaseException:
            self._restore(before)
            raise
        return BufferReport(
            updates=updates,
            reward_mean=float(rewards[buffer.valid].mean()),
            advantage_abs_mean=float(advantages.advantages_N[kept].abs().mean()),
            zero_std_ratio=advantages.num_zero_std / advantages.num_groups,
            invalid=advantages.num_invalid,
            kept=int(kept.sum()),
            group_size=len(buffer) / advantages.num_groups,
            noise_share=buffer.rollout.spent_noise,
        )

    def gradients(self, buffer: RolloutBuffer, rows: "_Row", advantages: GroupAdvantages) -> dict[str, float]:
        """Accumulate the gradient of L = -J + beta KL over the rows into .grad; return the sums for a report."""
        device = next(self.model.parameters()).device
        total, sums = (
            len(rows.videos),
            dict.fromkeys(("objective", "kl", "ratio", "low", "high", "train_s", "kl_s"), 0.0),
        )
        weights = self._step_weights(buffer, rows) if self.settings.equalise else None
        own = self.ranks.share(torch.arange(total))
        for index in torch.split(own, self.settings.micro_batch):  # type: ignore[no-untyped-call]
            start = time.perf_counter()
            videos, positions = rows.videos[index], rows.positions[index]
            new, old_zeta = self._new_and_old(buffer, videos, positions)
            ratio = self._log_ratio(new, old_zeta, buffer, videos, positions)
            signal = advantages.advantages_N[videos].to(device, torch.float32)
            objective = clipped_objective(
                ratio, signal, clip_low=self.settings.clip_low, clip_high=self.settings.clip_high
            )
            if weights is not None:
                objective = objective * weights[positions].to(device)
            middle = time.perf_counter()
            kl = self._kl(new, old_zeta, ratio, buffer, videos, positions)
            kl_seconds = time.perf_counter() - middle
            loss = (self.settings.kl.beta * kl - objective).sum() / total
            loss.backward()  # type: ignore[no-untyped-call]
            low, high = clip_tails(ratio.detach(), clip_low=self.settings.clip_low, clip_high=self.settings.clip_high)
            sums["objective"] += float(objective.detach().sum())
            sums["kl"] += float(kl.detach().sum())
            sums["ratio"] += float(ratio.detach().exp().sum())
            sums["low"] += low * len(index) if len(index) else 0.0  # a share of none is not a number
            sums["high"] += high * len(index) if len(index) else 0.0
            sums["kl_s"] += kl_seconds
            sums["train_s"] += time.perf_counter() - start - kl_seconds
        values = torch.tensor(list(sums.values()), dtype=torch.float64)
        self.ranks.sum_(values)
        return dict(zip(sums, values.tolist(), strict=True))

    def averaged_weights(self) -> AbstractContextManager[None]:
        """A context in which the model has its averaged weights, for evaluation; without EMA, its own."""
        return _Swapped(self.model, self.averaged) if self.averaged else nullcontext()

    # internals

    def _advantages(self, rewards: Tensor, buffer: RolloutBuffer) -> GroupAdvantages:
        settings = self.settings.advantage
        return group_advantages(
            rewards, buffer.group_ids, buffer.valid, clip=settings.clip, std_scope=settings.std_scope,
            ddof=settings.ddof, running=self._running if settings.std_scope == "running" else None,
        )  # fmt: skip

    def _passes(self, buffer: RolloutBuffer, kept: Tensor) -> Iterator[_Row]:
        chosen = select_steps(
            self.rollout.times, list(buffer.rollout.steps), len(buffer), fraction=self.settings.step_fraction,
            select=self.settings.step_select, min_s=self.settings.min_s, seed=self.seed, iteration=buffer.iteration,
        )  # fmt: skip
        chosen &= kept.unsqueeze(1)
        count = self.settings.updates_per_buffer
        for update in range(count):
            rows = chosen
            if self.settings.passes == "parts":
                rows = chosen & (torch.arange(len(buffer)) % count == update).unsqueeze(1)
            videos, positions = torch.nonzero(rows, as_tuple=True)
            if len(videos):
                yield _Row(videos, positions)

    def _update(self, buffer: RolloutBuffer, rows: _Row, advantages: GroupAdvantages) -> UpdateReport:
        if self._anchor and self._anchor_moves and self.version % self.settings.kl.moving_updates == 0:
            self._anchor.load_state_dict(self.model.state_dict())
        self.model.train()
        self._optimizer.zero_grad(set_to_none=True)
        sums = self.gradients(buffer, rows, advantages)
        self.ranks.sum_gradients(self.model)
        norm = clip_grad_norm_(self.parameters, self.settings.max_grad_norm)
        if not bool(torch.isfinite(norm)):
            raise FloatingPointError(
                f"GRPO: the gradient is not finite at version {self.version}; lower the learning rate"
            )
        self._optimizer.step()
        self.version += 1
        decay = min(self.settings.ema_decay, (1 + self.version) / (10 + self.version))
        for name, parameter in _trained(self.model):
            if name in self.averaged:
                self.averaged[name].lerp_(parameter.detach(), 1 - decay)
        total = len(rows.videos)
        return UpdateReport(
            objective=sums["objective"] / total, kl=sums["kl"] / total, ratio_mean=sums["ratio"] / total,
            clip_low_share=sums["low"] / total, clip_high_share=sums["high"] / total, grad_norm=float(norm),
            transitions=total, train_seconds=sums["train_s"], kl_seconds=sums["kl_s"],
        )  # fmt: skip

    def _transition(
        self, model: nn.Module, buffer: RolloutBuffer, videos: Tensor, positions: Tensor, mask: Tensor | None
    ) -> Transition:
        device = next(self.model.parameters()).device
        steps = torch.tensor(buffer.rollout.steps)[positions]
        where = torch.tensor([buffer.rollout.state_steps.index(k) for k in buffer.rollout.steps])[positions]
        condition = buffer.condition.rows(videos).to(device)
        times = self.rollout.times
        return transition(
            model, condition, buffer.rollout.states[videos, where].to(device),
            buffer.rollout.states[videos, where + 1].to(device), times[steps], times[steps + 1],
            None if mask is None else mask.to(device), self.rollout, cfg=self.settings.cfg,
        )  # fmt: skip

    def _new_and_old(self, buffer: RolloutBuffer, videos: Tensor, positions: Tensor) -> tuple[Transition, Tensor]:
        mask = buffer.rollout.mask[videos, positions] if self.settings.mask_source == "cached" else None
        new = self._transition(self.model, buffer, videos, positions, mask)
        return new, self._stored_zeta(buffer, videos, positions).to(new.zeta.device)

    def _stored_zeta(self, buffer: RolloutBuffer, videos: Tensor, positions: Tensor) -> Tensor:
        if buffer.rollout.zeta is not None:
            return buffer.rollout.zeta[videos, positions].flatten(1).float()
        shape, K = tuple(buffer.rollout.latents.shape[1:]), buffer.condition.num_conditioning
        steps = [buffer.rollout.steps[position] for position in positions.tolist()]
        rows = [
            step_noise(shape, buffer.rollout.seeds[i : i + 1], k) for i, k in zip(videos.tolist(), steps, strict=True)
        ]
        return torch.cat(rows)[:, :, K:].flatten(1)

    def _log_ratio(
        self, new: Transition, old_zeta: Tensor, buffer: RolloutBuffer, videos: Tensor, positions: Tensor
    ) -> Tensor:
        if self.settings.mask_source == "recompute":
            return self._recomputed_log_ratio(new, old_zeta, buffer, videos, positions)
        if self.settings.ratio_norm:
            return normalised_log_ratio(new.zeta, old_zeta, new.std)
        weight: Tensor | float = 1.0
        if self.settings.logprob_weight == "cps":
            weight = 2 * new.std.square()
        elif self.settings.logprob_weight == "base":
            weight = (new.std / new.sigma_base.unsqueeze(1)).square()
        return log_ratio(new.zeta, old_zeta, weight)

    def _recomputed_log_ratio(
        self, new: Transition, old_zeta: Tensor, buffer: RolloutBuffer, videos: Tensor, positions: Tensor
    ) -> Tensor:
        """Ablation: the current weights choose the mask too, so all three terms of (12) stay in the ratio."""
        old_std, zeros = self._old_std(new, buffer, videos, positions), torch.zeros_like(new.zeta)
        return gaussian_logprob(new.zeta * new.std, zeros, new.std) - gaussian_logprob(
            old_zeta * old_std, zeros, old_std
        )

    def _old_std(self, new: Transition, buffer: RolloutBuffer, videos: Tensor, positions: Tensor) -> Tensor:
        """The deviation at rollout, (M, U); not that of `new` where the current weights chose the mask."""
        if self.settings.mask_source == "cached" or self.rollout.sampler.arm != "dyndiff":
            return new.std
        s = self.rollout.times[torch.tensor(buffer.rollout.steps)[positions] + 1]
        mask = buffer.rollout.mask[videos, positions].to(new.std.device)
        std = masked_deviation(mask, s, self.rollout.sampler)[:, :, buffer.condition.num_conditioning :]
        return std.expand(-1, buffer.rollout.latents.shape[1], -1, -1, -1).flatten(1)

    def _kl(
        self, new: Transition, old_zeta: Tensor, ratio: Tensor, buffer: RolloutBuffer, videos: Tensor, positions: Tensor
    ) -> Tensor:
        settings = self.settings.kl
        if settings.mode == "none" or settings.beta == 0:
            return torch.zeros_like(ratio)
        if settings.mode in ("logk2", "logk3"):
            return log_space_kl(ratio, settings.mode)
        kl = torch.zeros_like(ratio)
        if self.settings.mask_source == "recompute":  # the anchor's deviation is the rollout's: measure in it
            old_std = self._old_std(new, buffer, videos, positions)
            new = new._replace(zeta=new.zeta * (new.std / old_std), std=old_std)
        if settings.anchor in ("buffer", "dual"):
            kl = kl + self._distance(new, old_zeta)
        due = settings.anchor in ("frozen", "moving", "lora_off") or self.version % settings.dual_every == 0
        if settings.anchor != "buffer" and due:
            kl = kl + self._distance(new, self._anchor_zeta(buffer, videos, positions, new))
        return kl

    def _distance(self, new: Transition, target_zeta: Tensor) -> Tensor:
        if self.settings.kl.mode == "velocity":
            return velocity_kl(new.zeta, target_zeta, new.std, new.slope)
        return mean_kl(new.zeta, target_zeta)

    @torch.no_grad()
    def _anchor_zeta(self, buffer: RolloutBuffer, videos: Tensor, positions: Tensor, new: Transition) -> Tensor:
        mask = buffer.rollout.mask[videos, positions]
        if self.settings.kl.anchor != "lora_off":
            assert self._anchor is not None
            return self._transition(self._anchor, buffer, videos, positions, mask).zeta
        disable: Any = getattr(self.model, "disable_adapter", None)
        if disable is None:
            raise ValueError(
                "kl.anchor lora_off needs a model with a LoRA adapter; set lora.rank, or take kl.anchor frozen"
            )
        with disable():
            return self._transition(self.model, buffer, videos, positions, mask).zeta

    @torch.no_grad()
    def _step_weights(self, buffer: RolloutBuffer, rows: _Row) -> Tensor:
        """SAGE's equaliser over the stochastic steps, (S,), from the sensitivity rms_u |d mean / d v| / std."""
        S = len(buffer.rollout.steps)
        first = rows.videos[:1].expand(S)
        law = self._transition(self.model, buffer, first, torch.arange(S), buffer.rollout.mask[first, torch.arange(S)])
        return step_equaliser((law.slope / law.std).square().mean(1).sqrt().cpu())

    def _snapshot(self) -> dict[str, Any]:
        return {
            "model": {name: p.detach().clone() for name, p in _trained(self.model)},
            "optimizer": copy.deepcopy(self._optimizer.state_dict()),
            "averaged": {name: value.clone() for name, value in self.averaged.items()},
            "anchor": copy.deepcopy(self._anchor.state_dict()) if self._anchor and self._anchor_moves else None,
            "running": copy.copy(self._running),
            "version": self.version,
        }

    def _restore(self, before: dict[str, Any]) -> None:
        _set_trained(self.model, before["model"])
        self._optimizer.load_state_dict(before["optimizer"])
        if self._anchor and before["anchor"]:
            self._anchor.load_state_dict(before["anchor"])
        self.averaged, self.version, self._running = before["averaged"], before["version"], before["running"]

    # checkpoints

    def save(self, path: Path, *, iteration: int) -> None:
        """Write everything that train() depends on, atomically: trained weights, EMA, anchor, optimizer, counters."""
        tensors = {f"model.{name}": p for name, p in _trained(self.model)}
        tensors |= {f"averaged.{name}": value for name, value in self.averaged.items()}
        if self._anchor is not None:
            tensors |= {f"anchor.{name}": value for name, value in self._anchor.state_dict().items()}
        tensors |= {f"optimizer.{key}": value for key, value in optimizer_tensors(self._optimizer).items()}
        header = {"version": self.version, "seed": self.seed, "iteration": iteration}
        header |= {f.name: getattr(self._running, f.name) for f in fields(self._running)}
        tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
        write_atomic(path, save(tensors, {"grpo": json.dumps(header)}))

    def load(self, path: Path) -> int:
        """Continue exactly from save(); return its iteration.

        Raises:
            ValueError: the file is of another architecture or seed.
        """
        data = path.read_bytes()
        tensors = load(data)
        header = json.loads(metadata_of(data)["grpo"])
        if header["seed"] != self.seed:
            raise ValueError(
                f"{path} was made with seed {header['seed']}, this run has {self.seed}; use a new run folder"
            )
        weights = section(tensors, "model.")
        check_same_layout(dict(_trained(self.model)), weights, what=str(path))
        _set_trained(self.model, weights)
        device = next(self.model.parameters()).device
        self.averaged = {name: value.to(device) for name, value in section(tensors, "averaged.").items()}
        if self._anchor is not None:
            self._anchor.load_state_dict(section(tensors, "anchor."))
        restore_optimizer(self._optimizer, section(tensors, "optimizer."))
        self._running = RunningStd(header["sum_of_squares"], header["count"])
        self.version = header["version"]
        return int(header["iteration"])


def mixed_reward(buffer: RolloutBuffer) -> Tensor:
    """The reward that trains, float64 (N,): the buffer's `total`, or its only reward."""
    if "total" in buffer.rewards:
        return buffer.rewards["total"]
    if len(buffer.rewards) == 1:
        return next(iter(buffer.rewards.values()))
    raise ValueError(f"the buffer holds rewards {', '.join(buffer.rewards) or '(none)'} and no `total`; mix them first")


class _Swapped(AbstractContextManager[None]):
    """The model with other values of its trained parameters, for a while."""

    def __init__(self, model: nn.Module, values: dict[str, Tensor]) -> None:
        self._model, self._values = model, values

    def __enter__(self) -> None:
        self._own = {name: p.detach().clone() for name, p in _trained(self._model)}
        _set_trained(self._model, self._values)

    def __exit__(self, *_: object) -> None:
        _set_trained(self._model, self._own)


def _trained(model: nn.Module) -> Iterator[tuple[str, Tensor]]:
    return ((name, p) for name, p in model.named_parameters() if p.requires_grad)


@torch.no_grad()
def _set_trained(model: nn.Module, values: dict[str, Tensor]) -> None:
    for name, parameter in _trained(model):
        parameter.copy_(values[name])
