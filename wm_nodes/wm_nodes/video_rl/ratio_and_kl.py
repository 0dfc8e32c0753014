"""The two terms of GRPO's loss on stored transitions: the objective of the ratio of likelihoods (DD-14b to DD-16) and
the KL to an anchor (DD-17, DD-20).

Shapes: M transitions (video, step) of one network call, U generated elements, S stochastic steps.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from wm_nodes.config.video import GrpoConfig
from wm_nodes.core.device import device_of
from wm_nodes.video_model.buffer import RolloutBuffer
from wm_nodes.video_model.kernels import masked_deviation
from wm_nodes.video_model.sampling import RolloutSettings, step_noise
from wm_nodes.video_model.step_window import select_steps
from wm_nodes.video_model.transitions import GaussianTransition, transition
from wm_nodes.video_rl.grpo_math import (
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


@dataclass(frozen=True)
class Rows:
    """What one optimizer step trains on: videos of a buffer, and positions among its stochastic steps (objective nft:
    among the times of a video), int64 (M,), in the host's memory."""

    videos: Tensor
    positions: Tensor

    def __len__(self) -> int:
        return len(self.videos)

    def part(self, index: Tensor) -> "Rows":
        return Rows(self.videos[index], self.positions[index])

    def of(self, stored: Tensor, positions: Tensor | None = None) -> Tensor:
        """Return the rows (M, ...) of a tensor (N, S, ...) where that lies; positions: others than their own."""
        places = self.positions if positions is None else positions
        index = torch.stack([self.videos, places]).to(stored.device)
        return stored[index[0], index[1]]


class Pass(NamedTuple):
    """One pass of the current weights. objective, log_ratio: (M,). new: with gradient. old_zeta: of the rollout,
    (M, U)."""

    objective: Tensor
    new: GaussianTransition
    old_zeta: Tensor
    log_ratio: Tensor


class Anchored:
    """A loss on `model` with weights beside it: an anchor's, and with objective nft those of v_old.

    They are copies of the parameters that train, nothing else: with LoRA as small as the adapter.

    Raises:
        ValueError: the anchor is a model without its adapter, and there is none.
    """

    def __init__(self, model: nn.Module, settings: GrpoConfig, rollout: RolloutSettings, seed: int) -> None:
        if settings.kl.anchor == "lora_off" and not hasattr(model, "disable_adapter"):
            raise ValueError(
                "kl.anchor lora_off needs a model with a LoRA adapter; add one (video_model.adapters.add_lora), or "
                "take kl.anchor frozen"
            )
        self.model, self.settings, self.rollout, self.seed = model, settings, rollout, seed
        self.anchor: dict[str, Tensor] = {}
        """Parameters of a frozen or moving anchor by name; empty where the buffer or the bare model is the anchor."""
        self.old: dict[str, Tensor] = {}
        """Parameters of v_old (DD-31) by name; empty with objective ratio."""
        if settings.kl.anchor in ("frozen", "moving", "dual"):
            self.move_anchor()

    def move_anchor(self) -> None:
        """Make the model's current parameters the anchor."""
        self.anchor = self.trained()

    def move_old(self, version: int) -> None:
        """Move the old weights after a buffer. version: optimizer steps made."""

    def trained(self) -> dict[str, Tensor]:
        """Copy the model's parameters that train."""
        return {name: p.detach().clone() for name, p in self.model.named_parameters() if p.requires_grad}

    def call(self, weights: dict[str, Tensor], *arguments: Any) -> Any:
        """Call the model with other weights, while the current ones keep their graph."""
        return functional_call(self.model, weights, arguments)

    @contextmanager
    def anchored(self) -> Iterator[Callable[..., Any]]:
        """Give the model as it is at the anchor."""
        if self.settings.kl.anchor != "lora_off":
            yield partial(self.call, self.anchor)
            return
        disable: Any = self.model.disable_adapter
        with disable():
            yield self.model


class GrpoTerms(Anchored):
    """Objective and KL of transitions by the ratio of their likelihoods under `model`."""

    def choose(self, buffer: RolloutBuffer) -> Tensor:
        """Return which transitions train, bool (N, S)."""
        return select_steps(
            self.rollout.times, list(buffer.rollout.steps), len(buffer), fraction=self.settings.step_fraction,
            select=self.settings.step_select, min_s=self.settings.min_s, seed=self.seed, iteration=buffer.iteration,
        )

    def objective(self, buffer: RolloutBuffer, rows: Rows, signals_M: Tensor, version: int) -> Pass:
        """Run the current weights; return DD-16 of DD-15, or of DD-15b with ratio_norm. signals_M: the advantages."""
        cached = self.settings.mask_source == "cached"
        new = self._transition(self.model, buffer, rows, self._mask(buffer, rows) if cached else None)
        old_zeta = _stored_zeta(buffer, rows).to(new.zeta.device)
        ratio = self._log_ratio(new, old_zeta, buffer, rows)
        return Pass(clipped_objective(ratio, signals_M, **self._limits), new, old_zeta, ratio)

    def kl(self, current: Pass, buffer: RolloutBuffer, rows: Rows, version: int) -> Tensor:
        """Return DD-17 or DD-20 per transition, (M,). version: optimizer steps made, for the dual anchor."""
        settings, kl = self.settings.kl, torch.zeros_like(current.log_ratio)
        if settings.mode == "none" or settings.beta == 0:
            return kl
        if settings.anchor in ("buffer", "dual"):
            kl = kl + self._distance(current.new, current.old_zeta, buffer, rows)
        due = settings.anchor in ("frozen", "moving", "lora_off") or version % settings.dual_every == 0
        if settings.anchor != "buffer" and due:
            kl = kl + self._distance(current.new, self._anchor_zeta(buffer, rows), buffer, rows)
        return kl

    def sums(self, current: Pass, kl: Tensor) -> Tensor:
        """Return the sums of kl and ratio, and the counts of ratios beyond either clip, float64 (4,)."""
        ratio = current.log_ratio.detach()
        tails = [share * len(ratio) for share in clip_tails(ratio, **self._limits)]
        return torch.stack([kl.detach().sum().double(), ratio.exp().sum().double(), *tails])

    @torch.no_grad()
    def step_weights(self, buffer: RolloutBuffer, rows: Rows) -> Tensor | None:
        """Return SAGE's equaliser, (S,), from the sensitivity rms_u |d mean / d v| / std of the first video that
        trains; None without equalise."""
        if not self.settings.equalise:
            return None
        S = len(buffer.rollout.steps)
        rows = Rows(rows.videos[:1].expand(S), torch.arange(S))
        law = self._transition(self.model, buffer, rows, self._mask(buffer, rows))
        return step_equaliser((law.slope / law.std).square().mean(1).sqrt().cpu())

    # internals

    @property
    def _limits(self) -> dict[str, float]:
        return {"clip_low": self.settings.clip_low, "clip_high": self.settings.clip_high}

    def _transition(
        self, model: Callable[..., Any], buffer: RolloutBuffer, rows: Rows, mask: Tensor | None
    ) -> GaussianTransition:
        device = device_of(self.model)
        rollout, times = buffer.rollout, self.rollout.times
        steps = torch.tensor(rollout.steps)[rows.positions]
        where = torch.tensor([rollout.state_steps.index(k) for k in rollout.steps])[rows.positions]
        x_t, x_s = (rows.of(rollout.states, places).to(device) for places in (where, where + 1))
        t, s = times[torch.stack([steps, steps + 1])].to(device)
        condition = buffer.condition.rows(rows.videos.to(buffer.condition.frames.device)).to(device)
        mask = None if mask is None else mask.to(device)
        return transition(model, condition, x_t, x_s, t, s, mask, self.rollout, cfg=self.settings.cfg)

    @staticmethod
    def _mask(buffer: RolloutBuffer, rows: Rows) -> Tensor:
        return rows.of(buffer.rollout.mask)

    def _log_ratio(self, new: GaussianTransition, old_zeta: Tensor, buffer: RolloutBuffer, rows: Rows) -> Tensor:
        if self.settings.mask_source == "recompute":
            return self._recomputed_log_ratio(new, old_zeta, buffer, rows)
        if self.settings.ratio_norm:
            return normalised_log_ratio(new.zeta, old_zeta, new.std)
        weight: Tensor | float = 1.0
        if self.settings.logprob_weight == "cps":
            weight = 2 * new.std.square()
        elif self.settings.logprob_weight == "base":
            weight = (new.std / new.sigma_base.unsqueeze(1)).square()
        return log_ratio(new.zeta, old_zeta, weight)

    def _recomputed_log_ratio(
        self, new: GaussianTransition, old_zeta: Tensor, buffer: RolloutBuffer, rows: Rows
    ) -> Tensor:
        """Ablation: the current weights choose the mask too, so all three terms of DD-12 stay in the ratio."""
        old_std, zeros = self._old_std(new, buffer, rows), torch.zeros_like(new.zeta)
        logprob = gaussian_logprob(new.zeta * new.std, zeros, new.std)
        return logprob - gaussian_logprob(old_zeta * old_std, zeros, old_std)

    def _old_std(self, new: GaussianTransition, buffer: RolloutBuffer, rows: Rows) -> Tensor:
        """The deviation at rollout, (M, U); not that of `new` where the current weights chose the mask."""
        if self.settings.mask_source == "cached" or self.rollout.sampler.arm != "dyndiff":
            return new.std
        s = self.rollout.times[torch.tensor(buffer.rollout.steps)[rows.positions] + 1]
        std = masked_deviation(self._mask(buffer, rows).to(new.std.device), s, self.rollout.sampler)
        generated = std[:, :, buffer.condition.num_conditioning :]
        return generated.expand(-1, buffer.rollout.latents.shape[1], -1, -1, -1).flatten(1)

    def _distance(self, new: GaussianTransition, target_zeta: Tensor, buffer: RolloutBuffer, rows: Rows) -> Tensor:
        mode = self.settings.kl.mode
        if mode == "logk2" or mode == "logk3":
            return log_space_kl(self._log_ratio(new, target_zeta, buffer, rows), mode)
        zeta, std = new.zeta, new.std
        if self.settings.mask_source == "recompute":  # the anchor's deviation is the rollout's: measure in it
            std = self._old_std(new, buffer, rows)
            zeta = zeta * (new.std / std)
        return velocity_kl(zeta, target_zeta, std, new.slope) if mode == "velocity" else mean_kl(zeta, target_zeta)

    @torch.no_grad()
    def _anchor_zeta(self, buffer: RolloutBuffer, rows: Rows) -> Tensor:
        with self.anchored() as model:
            return self._transition(model, buffer, rows, self._mask(buffer, rows)).zeta


def _stored_zeta(buffer: RolloutBuffer, rows: Rows) -> Tensor:
    """Return the normalised noise of the rollout, float32 (M, U); drawn again where only seeds are kept."""
    if buffer.rollout.zeta is not None:
        return rows.of(buffer.rollout.zeta).flatten(1).float()
    shape, K = tuple(buffer.rollout.latents.shape[1:]), buffer.condition.num_conditioning
    steps = [buffer.rollout.steps[position] for position in rows.positions.tolist()]
    pairs = zip(rows.videos.tolist(), steps, strict=True)
    noise = torch.cat([step_noise(shape, buffer.rollout.seeds[i : i + 1], k) for i, k in pairs])
    return noise[:, :, K:].flatten(1)
