"""RL of a flow-matching video model on a rollout buffer: GRPO (DD-13 to DD-18, DD-20), or with grpo.objective nft
DiffusionNFT (DD-31); averaged weights: DD-30.

Shapes: N videos, S stochastic steps, M transitions (video, step) of one network call, U generated elements.

One buffer serves `updates_per_buffer` optimizer steps. Each one accumulates over every kept (video, step) pair, divided
by their number, so that micro-batches and ranks do not change it. On the first one the ratio is 1 and DD-20 is 0. With
objective nft forward times stand in for the steps.

Everything is computed where the model is; a buffer may lie there or in the host's memory, from where it is moved by
micro-batches.
"""

import copy
import json
import math
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_

from wm_nodes.config.video import GrpoConfig
from wm_nodes.core.device import device_of, synchronize
from wm_nodes.training import checkpoint
from wm_nodes.training.ranks import Ranks
from wm_nodes.training.weights import WeightsError, check_same_layout
from wm_nodes.video_model.buffer import RolloutBuffer
from wm_nodes.video_model.sampling import RolloutSettings
from wm_nodes.video_rl.group_advantages import (
    GroupAdvantages,
    RunningStd,
    best_of_n,
    group_advantages,
    mixed_advantages,
    trainable,
    win_rates,
)
from wm_nodes.video_rl.nft import NftTerms
from wm_nodes.video_rl.ratio_and_kl import GrpoTerms, Rows

SUMS = ("objective", "kl", "ratio", "low", "high", "forward_s", "kl_s", "backward_s")
MAX_SKIPPED = 5
"""So many buffers in a row whose rewards differ in no group end a training: nothing can be learned from the reward."""


@dataclass(frozen=True)
class UpdateReport:
    """One optimizer step; see docs/metrics.md. clip_low_share, clip_high_share: of transitions, by tail.

    With objective nft there is no ratio: it and the clips are NaN, as is the KL without an anchor.
    *_seconds: forward of the weights that train; the anchor's forward and the KL; backward of both.
    """

    objective: float
    kl: float
    ratio_mean: float
    clip_low_share: float
    clip_high_share: float
    grad_norm: float
    transitions: int
    forward_seconds: float
    kl_seconds: float
    backward_seconds: float


@dataclass(frozen=True)
class BufferReport:
    """The training on one buffer.

    updates: one report per optimizer step, in order (index 0 is on-policy); none where the rewards differ in no group.
    skipped: such buffers in a row, up to this one. dropped_groups: those with fewer valid videos than trainable() asks
    for; they are in zero_std_ratio too. raw_rewards: mean of each score beside the total over the videos that have it,
    NaN where none has. step_noise: noise_share of each stochastic sampler step.
    """

    updates: tuple[UpdateReport, ...]
    reward_mean: float
    advantage_abs_mean: float
    zero_std_ratio: float
    invalid: int
    skipped: int
    dropped_groups: int
    kept: int
    group_size: float
    noise_share: float
    raw_rewards: Mapping[str, float]
    step_noise: Mapping[int, float]


class GrpoLearner:
    """Trains `model` in place; with settings.trains condition its other parameters no longer ask for a gradient.

    Args:
        seed: of the step selection (stream `step_selection`), and of noise and times (objective nft: stream `nft`).
        reward_weights: of the buffer's raw rewards, for advantage.mix advantage; their `total` is then only reported.
        ranks: this process's place among the learner's processes; all hold the whole buffer.
    """

    def __init__(
        self, model: nn.Module, settings: GrpoConfig, rollout: RolloutSettings, *, seed: int,
        ranks: Ranks | None = None, reward_weights: Mapping[str, float] | None = None,
    ) -> None:
        if settings.objective == "ratio" and (rollout.sampler.arm == "ode" or rollout.sampler.eta == 0):
            raise ValueError(
                "an ODE rollout has no likelihood to train on; choose a stochastic arm and eta > 0, or grpo.objective "
                "nft"
            )
        if settings.advantage.mix == "advantage" and settings.advantage.std_scope == "running":
            raise ValueError("advantage.std_scope running is of one reward; with advantage.mix advantage take group")
        if settings.mask_source == "recompute":
            warnings.warn(
                "grpo.mask_source recompute is an ablation: mask cells that flip throw the ratio out of its clip "
                "range. Otherwise take cached",
                stacklevel=2,
            )
        if settings.trains == "condition":
            _train_condition(model)
        self.model, self.settings, self.rollout, self.seed = model, settings, rollout, seed
        self.ranks, self.reward_weights = ranks or Ranks(), dict(reward_weights or {})
        self.version = 0
        """Optimizer steps made so far: the policy version of the weights."""
        self.skipped = 0
        """Buffers in a row, up to now, that no optimizer step was made on."""
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        self._optimizer = torch.optim.AdamW(
            self.parameters, lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self._running = RunningStd()
        self._terms = (NftTerms if settings.objective == "nft" else GrpoTerms)(model, settings, rollout, seed)
        self.averaged = self._terms.trained() if settings.ema_decay > 0 else {}

    def train(self, buffer: RolloutBuffer) -> BufferReport:
        """Make `updates_per_buffer` optimizer steps; nothing has changed when it raises.

        A buffer whose rewards differ in no group is skipped: its report has no updates, the weights stay.

        Raises:
            RolloutBufferError: another sampler configuration, or a stale buffer.
            ValueError: a reward that is marked valid and not finite, no group with enough valid ones, MAX_SKIPPED
                buffers in a row without spread, or no generated frame.
            FloatingPointError: a loss or gradient is not finite.
        """
        buffer.check(self.rollout, self.version, self.settings.max_staleness)
        if buffer.condition.num_conditioning >= buffer.rollout.latents.shape[2]:
            raise ValueError(
                f"all {buffer.rollout.latents.shape[2]} frames of these videos are given: nothing was generated that "
                f"could be learned from; give fewer"
            )
        rewards, before = mixed_reward(buffer), self._snapshot()
        trains = torch.from_numpy(trainable(buffer.valid.numpy(), buffer.group_ids.numpy()))
        advantages = self._advantages(rewards, buffer, trains)
        invalid = int((~buffer.valid).sum())
        dropped = advantages.num_groups - len(set(buffer.group_ids[trains].tolist()))
        kept = best_of_n(
            advantages.advantages_N, buffer.group_ids, advantages.kept_N, self.settings.advantage.best_of_n
        )
        skipped = 0 if bool(kept.any()) else self.skipped + 1
        if not bool(trains.any()) or skipped >= MAX_SKIPPED:
            raise ValueError(
                f"nothing to learn from: {invalid} of {len(buffer)} rewards are invalid, {dropped} of "
                f"{advantages.num_groups} groups have too few valid ones and {advantages.num_zero_std - dropped} no "
                f"spread; {self.skipped} buffers before it were skipped; look at the reward"
            )
        try:
            updates = tuple(self._update(buffer, rows, advantages) for rows in self._passes(buffer, kept))
            if updates:
                self._terms.move_old(self.version)
        except BaseException:
            self._restore(before)
            raise
        self.skipped = skipped
        return BufferReport(
            updates=updates,
            reward_mean=float(rewards[buffer.valid].mean()),
            advantage_abs_mean=float(advantages.advantages_N[kept].abs().mean()),
            zero_std_ratio=advantages.num_zero_std / advantages.num_groups,
            invalid=invalid,
            skipped=skipped,
            dropped_groups=dropped,
            kept=int(kept.sum()),
            group_size=len(buffer) / advantages.num_groups,
            noise_share=buffer.rollout.spent_noise,
            raw_rewards={
                name: float(values[torch.isfinite(values)].mean())
                for name, values in buffer.rewards.items() if name != "total"
            },
            step_noise=dict(zip(buffer.rollout.steps, buffer.rollout.noise_share.tolist(), strict=True)),
        )

    def gradients(self, buffer: RolloutBuffer, rows: "Rows", advantages: GroupAdvantages) -> dict[str, float]:
        """Accumulate the gradient of L = -J + beta KL over the rows into .grad; return the sums for a report."""
        device, total, seconds = device_of(self.model), len(rows), [0.0, 0.0, 0.0]
        sums = torch.zeros(5, dtype=torch.float64, device=device)
        signals = advantages.advantages_N.to(device, torch.float32)
        weights = self._terms.step_weights(buffer, rows)
        own = self.ranks.share(torch.arange(total))
        for index in torch.split(own, self.settings.micro_batch):  # type: ignore[no-untyped-call]
            clock, part = [self._now(device)], rows.part(index)
            current: Any = self._terms.objective(buffer, part, signals[part.videos.to(device)], self.version)
            objective = current.objective
            if weights is not None:
                objective = objective * weights[part.positions].to(device)
            clock.append(self._now(device))
            kl = self._terms.kl(current, buffer, part, self.version)
            clock.append(self._now(device))
            loss = (self.settings.kl.beta * kl - objective).sum() / total
            loss.backward()
            clock.append(self._now(device))
            seconds = [spent + end - start for spent, (start, end) in zip(seconds, pairwise(clock), strict=True)]
            if len(index):  # a share of none is not a number
                sums[0] += objective.detach().sum().double()
                sums[1:] += self._terms.sums(current, kl)
        values = torch.cat([sums.cpu(), torch.tensor(seconds, dtype=torch.float64)])  # the only wait for the device
        self.ranks.sum_(values)
        return dict(zip(SUMS, values.tolist(), strict=True))

    def averaged_weights(self) -> AbstractContextManager[None]:
        """Return a context in which the model has its averaged weights, for evaluation; without EMA, its own."""
        return _swap_weights(self.model, self.averaged) if self.averaged else nullcontext()

    # internals

    def _advantages(self, rewards: Tensor, buffer: RolloutBuffer, trains: Tensor) -> GroupAdvantages:
        """trains: bool (N,), the videos that may be compared; see reward.agent.contract."""
        settings = self.settings.advantage

        def signal(values: Tensor) -> Tensor:
            return win_rates(values, buffer.group_ids, trains) if settings.source == "win_rate" else values

        shared: dict[str, Any] = {name: getattr(settings, name) for name in ("clip", "std_scope", "ddof", "floor")}
        if settings.mix == "advantage":
            values = {name: signal(value) for name, value in buffer.rewards.items()}
            return mixed_advantages(values, self.reward_weights, buffer.group_ids, trains, **shared)
        running = self._running if settings.std_scope == "running" else None
        return group_advantages(signal(rewards), buffer.group_ids, trains, **shared, running=running)

    @staticmethod
    def _now(device: torch.device) -> float:
        synchronize(device)
        return time.perf_counter()

    def _passes(self, buffer: RolloutBuffer, kept: Tensor) -> Iterator[Rows]:
        chosen = self._terms.choose(buffer) & kept.unsqueeze(1)
        count = self.settings.updates_per_buffer
        for update in range(count):
            rows = chosen
            if self.settings.passes == "parts":
                rows = chosen & (torch.arange(len(buffer)) % count == update).unsqueeze(1)
            videos, positions = torch.nonzero(rows, as_tuple=True)
            if len(videos):
                yield Rows(videos, positions)

    def _update(self, buffer: RolloutBuffer, rows: Rows, advantages: GroupAdvantages) -> UpdateReport:
        if self.settings.kl.anchor == "moving" and self.version % self.settings.kl.moving_updates == 0:
            self._terms.move_anchor()
        self.model.train()
        self._optimizer.zero_grad(set_to_none=True)
        sums = self.gradients(buffer, rows, advantages)
        self.ranks.sum_gradients(self.model)
        norm = float(clip_grad_norm_(self.parameters, self.settings.max_grad_norm))
        if not math.isfinite(norm):
            raise FloatingPointError(
                f"GRPO: the gradient is not finite at version {self.version}; lower the learning rate"
            )
        self._optimizer.step()
        self.version += 1
        decay = min(self.settings.ema_decay, (1 + self.version) / (10 + self.version))
        for name, parameter in _trained_parameters(self.model):
            if name in self.averaged:
                self.averaged[name].lerp_(parameter.detach(), 1 - decay)
        total = len(rows.videos)
        return UpdateReport(
            objective=sums["objective"] / total, kl=sums["kl"] / total, ratio_mean=sums["ratio"] / total,
            clip_low_share=sums["low"] / total, clip_high_share=sums["high"] / total, grad_norm=norm,
            transitions=total, forward_seconds=sums["forward_s"],
            kl_seconds=sums["kl_s"], backward_seconds=sums["backward_s"],
        )

    def _snapshot(self) -> dict[str, Any]:
        """Copy what a failed train() puts back, where it is: on a GPU that is once more the memory of the weights that
        train, of their two moments and of their average, and nothing crosses to the host."""
        return {
            "model": self._terms.trained(),
            "optimizer": {k: v.detach().clone() for k, v in checkpoint.optimizer_tensors(self._optimizer).items()},
            "averaged": {name: value.clone() for name, value in self.averaged.items()},
            "anchor": self._terms.anchor, "old": self._terms.old,  # replaced, never changed
            "running": copy.copy(self._running),
            "version": self.version,
        }

    def _restore(self, before: dict[str, Any]) -> None:
        _set_trained(self.model, before["model"])
        checkpoint.restore_optimizer(self._optimizer, before["optimizer"])
        for name, value in before["averaged"].items():
            self.averaged[name].copy_(value)
        self._terms.anchor, self._terms.old = before["anchor"], before["old"]
        self.version, self._running = before["version"], before["running"]

    # checkpoints

    def save(self, path: Path, *, iteration: int) -> None:
        """Write everything that train() depends on, atomically: trained, averaged, anchor's and old weights, optimizer,
        counters."""
        sections = {
            "model": dict(_trained_parameters(self.model)), "averaged": self.averaged, "anchor": self._terms.anchor,
            "old": self._terms.old, "optimizer": checkpoint.optimizer_tensors(self._optimizer),
        }
        header = {"version": self.version, "seed": self.seed, "iteration": iteration, "skipped": self.skipped}
        header |= {f.name: getattr(self._running, f.name) for f in fields(self._running)}
        checkpoint.write_checkpoint(path, sections, {"grpo": json.dumps(header)})

    def load(self, path: Path) -> int:
        """Continue exactly from save(); return its iteration.

        Raises:
            ValueError: the file is damaged, or of another architecture, seed, objective, KL anchor or EMA.
        """
        try:
            tensors, metadata = checkpoint.read_checkpoint(path)
            header = json.loads(metadata["grpo"])
        except (KeyError, ValueError) as error:
            raise WeightsError(f"{path} is no complete checkpoint of GRPO ({error}); use a new run folder") from error
        if header["seed"] != self.seed:
            raise ValueError(f"{path} has seed {header['seed']}, this run has {self.seed}; use a new run folder")
        weights = checkpoint.section(tensors, "model.")
        check_same_layout(dict(_trained_parameters(self.model)), weights, what=str(path))
        own = {
            "averaged.": (self.averaged, "ema_decay"), "anchor.": (self._terms.anchor, "kl.anchor"),
            "old.": (self._terms.old, "objective"),
        }
        for prefix, (values, setting) in own.items():
            if bool(values) != bool(checkpoint.section(tensors, prefix)):
                raise ValueError(f"{path} was made with another grpo.{setting}; resume with its settings")
        _set_trained(self.model, weights)
        device = device_of(self.model)
        self.averaged, self._terms.anchor, self._terms.old = (
            {name: value.to(device) for name, value in checkpoint.section(tensors, prefix).items()} for prefix in own
        )
        checkpoint.restore_optimizer(self._optimizer, checkpoint.section(tensors, "optimizer."))
        self._running = RunningStd(header["sum_of_squares"], header["count"])
        self.version, self.skipped = header["version"], header.get("skipped", 0)  # older files have skipped none
        return int(header["iteration"])


def _train_condition(model: nn.Module) -> None:
    condition_parameters: Any = getattr(model, "condition_parameters", None)
    if condition_parameters is None:
        raise ValueError(
            f"grpo.trains condition is of the embedded video model; {type(model).__name__} takes grpo.trains all, or a "
            "LoRA adapter"
        )
    model.requires_grad_(False)
    for parameter in condition_parameters():
        parameter.requires_grad_(True)


def mixed_reward(buffer: RolloutBuffer) -> Tensor:
    """Return the reward that trains, float64 (N,): the buffer's `total`, or its only reward."""
    if "total" in buffer.rewards:
        return buffer.rewards["total"]
    if len(buffer.rewards) == 1:
        return next(iter(buffer.rewards.values()))
    raise ValueError(f"the buffer holds rewards {', '.join(buffer.rewards) or '(none)'} and no `total`; mix them first")


@contextmanager
def _swap_weights(model: nn.Module, values: dict[str, Tensor]) -> Iterator[None]:
    """Give the trained parameters other values within the context."""
    own = {name: p.detach().clone() for name, p in _trained_parameters(model)}
    _set_trained(model, values)
    try:
        yield
    finally:
        _set_trained(model, own)


def _trained_parameters(model: nn.Module) -> Iterator[tuple[str, Tensor]]:
    return ((name, p) for name, p in model.named_parameters() if p.requires_grad)


@torch.no_grad()
def _set_trained(model: nn.Module, values: dict[str, Tensor]) -> None:
    for name, parameter in _trained_parameters(model):
        parameter.copy_(values[name])
