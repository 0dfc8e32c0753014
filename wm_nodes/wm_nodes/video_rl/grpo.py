"""RL of a flow-matching video model on a rollout buffer: GRPO (DD-13 to DD-18, DD-20), or with grpo.objective nft
DiffusionNFT (DD-31).

Shapes: N videos, S stochastic steps, M transitions (video, step) of one network call, U generated elements.

One buffer serves `updates_per_buffer` optimizer steps. Each one accumulates over every kept (video, step) pair, divided
by their number, so that micro-batches do not change it. On the first one the ratio is 1 and DD-20 is 0. With
objective nft forward times stand in for the steps.

Everything is computed where the model is; a buffer may lie there or in the host's memory, from where it is moved by
micro-batches.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_

from wm_nodes.config.video import GrpoConfig, RolloutConfig
from wm_nodes.core.device import device_of
from wm_nodes.training import checkpoint
from wm_nodes.training.weights import WeightsError, check_same_layout
from wm_nodes.video_model.buffer import RolloutBuffer
from wm_nodes.video_rl.group_advantages import GroupAdvantages, best_of_n, group_advantages
from wm_nodes.video_rl.nft import NftTerms
from wm_nodes.video_rl.ratio_and_kl import GrpoTerms, Rows, trained_parameters

SUMS = ("objective", "kl", "ratio_mean", "clip_low_share", "clip_high_share")
"""What an UpdateReport has the means of."""
MAX_SKIPPED = 5
"""So many buffers in a row whose rewards differ in no group end a training: nothing can be learned from the reward."""


class NothingToLearnError(ValueError):
    """The clips of a context are paid the same, in MAX_SKIPPED buffers in a row."""


@dataclass(frozen=True)
class UpdateReport:
    """One optimizer step; see docs/metrics.md.

    With objective nft there is no ratio: it and the clips are NaN.
    """

    objective: float
    """Mean of DD-16, or minus the loss of DD-31."""
    kl: float
    """Mean of DD-17 or DD-20."""
    ratio_mean: float
    """Mean of DD-15."""
    clip_low_share: float
    """Transitions whose ratio is below the clip."""
    clip_high_share: float
    """And above."""
    grad_norm: float
    """Before it is clipped."""
    transitions: int
    """(video, step) pairs."""


@dataclass(frozen=True)
class BufferReport:
    """The training on one buffer."""

    updates: tuple[UpdateReport, ...]
    """One per optimizer step, in order (index 0 is on-policy); none where the rewards differ in no group."""
    reward_mean: float
    """Over the valid videos."""
    advantage_abs_mean: float
    """Over the videos that train."""
    zero_std_ratio: float
    """Share of groups without spread."""
    invalid: int
    """Videos without a reward."""
    skipped: int
    """Buffers without updates in a row, up to this one."""
    dropped_groups: int
    """Those with too few rewards (RA-15); they are in zero_std_ratio too."""
    kept: int
    """Videos that train."""
    group_size: float
    """Mean over the groups."""
    noise_share: float
    """Noise budget that was spent, see VideoRollout.spent_noise."""
    raw_rewards: Mapping[str, float]
    """Mean of each score beside the total over the videos that have it, NaN where none has."""


class GrpoLearner:
    """Trains `model` in place; with settings.trains condition its other parameters no longer ask for a gradient.

    Args:
        seed: of the step selection (stream `step_selection`), and of noise and times (objective nft: stream `nft`).
    """

    def __init__(self, model: nn.Module, settings: GrpoConfig, rollout: RolloutConfig, *, seed: int) -> None:
        if settings.objective == "ratio" and (rollout.sampler.arm == "ode" or rollout.sampler.eta == 0):
            raise ValueError(
                "an ODE rollout has no likelihood to train on; choose a stochastic arm and eta > 0, or grpo.objective "
                "nft"
            )
        if settings.trains == "condition":
            _train_condition(model)
        self.model, self.settings, self.rollout, self.seed = model, settings, rollout, seed
        self.version = 0
        """Optimizer steps made so far: the policy version of the weights."""
        self.iterations = 0
        """Buffers trained on so far, those that were skipped among them."""
        self.skipped = 0
        """Buffers in a row, up to now, that no optimizer step was made on."""
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        narrow = {str(p.dtype).removeprefix("torch.") for p in self.parameters if p.dtype.itemsize < 4}
        if narrow and settings.learning_rate:
            raise ValueError(
                f"weights of {min(narrow)} round steps of learning_rate {settings.learning_rate:g} to nothing; load "
                "them as float32, or add a LoRA adapter (video_model.adapters.add_lora), which is float32"
            )
        self._optimizer = torch.optim.AdamW(
            self.parameters, lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.terms = (NftTerms if settings.objective == "nft" else GrpoTerms)(model, settings, rollout, seed)

    def train(self, buffer: RolloutBuffer) -> BufferReport:
        """Make `updates_per_buffer` optimizer steps; nothing has changed when it raises.

        A buffer whose rewards differ in no group is skipped: its report has no updates, the weights stay.

        Raises:
            RolloutBufferError: another sampler configuration, or other weights.
            ValueError: no group with enough finite rewards, MAX_SKIPPED buffers in a row without spread, or no
                generated frame.
            FloatingPointError: a loss or gradient is not finite.
        """
        buffer.check(self.rollout, self.version)
        if buffer.condition.num_conditioning >= buffer.rollout.latents.shape[2]:
            raise ValueError(
                f"all {buffer.rollout.latents.shape[2]} frames of these videos are given: nothing was generated that "
                f"could be learned from; give fewer"
            )
        rewards, valid = buffer.reward, buffer.valid
        # where it is: on a GPU once more the memory of the weights that train and of their two moments; the anchor is
        # never changed
        state, counters = self._state(), self._counters()
        before = state | {
            part: {name: tensor.detach().clone() for name, tensor in state[part].items()}
            for part in ("model", "optimizer")
        }
        settings = self.settings.advantage
        advantages = group_advantages(rewards, buffer.group_ids, clip=settings.clip, std_scope=settings.std_scope)
        invalid, dropped = int((~valid).sum()), advantages.num_dropped
        kept = best_of_n(advantages.advantages_N, buffer.group_ids, advantages.kept_N, settings.best_of_n)
        skipped = 0 if bool(kept.any()) else self.skipped + 1
        if dropped == advantages.num_groups or skipped >= MAX_SKIPPED:
            raise (ValueError if dropped == advantages.num_groups else NothingToLearnError)(
                f"nothing to learn from: {invalid} of {len(buffer)} rewards are invalid, {dropped} of "
                f"{advantages.num_groups} groups have too few valid ones and {advantages.num_zero_std - dropped} no "
                f"spread; {self.skipped} buffers before it were skipped; look at the reward"
            )
        try:
            rows = self.rows(buffer, kept)
            steps = self.settings.updates_per_buffer if len(rows) else 0
            self.terms.begin()
            updates = tuple(self._update(buffer, rows, advantages) for _ in range(steps))
        except BaseException:
            self._set_state(before, counters)
            raise
        self.skipped = skipped
        self.iterations += 1
        return BufferReport(
            updates=updates,
            reward_mean=float(rewards[valid].mean()),
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
        )

    def rows(self, buffer: RolloutBuffer, kept_N: Tensor) -> Rows:
        """Return what every update on the buffer trains on: the chosen steps of the kept videos."""
        return Rows(*torch.nonzero(self.terms.choose(buffer) & kept_N.unsqueeze(1), as_tuple=True))

    def gradients(self, buffer: RolloutBuffer, rows: Rows, advantages: GroupAdvantages) -> dict[str, float]:
        """Accumulate the gradient of L = -J + beta KL over the rows into .grad; return the sums for a report."""
        device, total = device_of(self.model), len(rows)
        sums = torch.zeros(5, dtype=torch.float64, device=device)
        signals = advantages.advantages_N.to(device, torch.float32)
        for index in torch.split(torch.arange(total), self.settings.micro_batch):  # type: ignore[no-untyped-call]
            part = rows.part(index)
            terms = self.terms.compute(buffer, part, signals[part.videos.to(device)], self.version)
            loss = (self.settings.kl.beta * terms.kl - terms.objective).sum() / total
            loss.backward()  # type: ignore[no-untyped-call]
            sums += terms.sums(self.settings.clip)
        return dict(zip(SUMS, sums.tolist(), strict=True))  # the only wait for the device

    # internals

    def _update(self, buffer: RolloutBuffer, rows: Rows, advantages: GroupAdvantages) -> UpdateReport:
        self.model.train()
        self._optimizer.zero_grad(set_to_none=True)
        sums = self.gradients(buffer, rows, advantages)
        norm = float(clip_grad_norm_(self.parameters, self.settings.max_grad_norm))
        if not math.isfinite(norm):
            raise FloatingPointError(
                f"GRPO: the gradient is not finite at version {self.version}; lower the learning rate"
            )
        self._optimizer.step()
        self.version += 1
        means = {name: value / len(rows) for name, value in sums.items()}
        return UpdateReport(**means, grad_norm=norm, transitions=len(rows))

    def _state(self) -> dict[str, dict[str, Tensor]]:
        """The tensors that train() depends on, not copied: trained and anchor's weights, optimizer."""
        return {
            "model": dict(trained_parameters(self.model)), "anchor": self.terms.anchor,
            "optimizer": checkpoint.optimizer_tensors(self._optimizer),
        }

    def _counters(self) -> dict[str, int]:
        return {"version": self.version, "iteration": self.iterations, "skipped": self.skipped}

    @torch.no_grad()
    def _set_state(self, state: Mapping[str, dict[str, Tensor]], counters: Mapping[str, int]) -> None:
        for name, parameter in trained_parameters(self.model):
            parameter.copy_(state["model"][name])
        checkpoint.restore_optimizer(self._optimizer, state["optimizer"])
        device = device_of(self.model)
        self.terms.anchor = {name: value.to(device) for name, value in state["anchor"].items()}
        self.version, self.iterations, self.skipped = counters["version"], counters["iteration"], counters["skipped"]

    # checkpoints

    def save(self, path: Path) -> None:
        """Write everything that train() depends on, atomically."""
        header = {**self._counters(), "seed": self.seed, "objective": self.settings.objective}
        checkpoint.write_checkpoint(path, self._state(), {"grpo": json.dumps(header)})

    def load(self, path: Path) -> None:
        """Continue exactly from save().

        Raises:
            ValueError: the file is damaged, or of another architecture, seed, objective or KL anchor.
        """
        try:
            tensors, metadata = checkpoint.read_checkpoint(path)
            header = json.loads(metadata["grpo"])
        except (KeyError, ValueError) as error:
            raise WeightsError(f"{path} is no complete checkpoint of GRPO ({error}); use a new run folder") from error
        if header["seed"] != self.seed:
            raise ValueError(f"{path} has seed {header['seed']}, this run has {self.seed}; use a new run folder")
        now = self._state()
        state = {part: checkpoint.section(tensors, f"{part}.") for part in now}
        check_same_layout(now["model"], state["model"], what=str(path))
        other_anchor = bool(now["anchor"]) != bool(state["anchor"])
        if other_anchor or header.get("objective", self.settings.objective) != self.settings.objective:
            setting = "kl.anchor" if other_anchor else "objective"
            raise ValueError(f"{path} was made with another grpo.{setting}; resume with its settings")
        self._set_state(state, header)


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
