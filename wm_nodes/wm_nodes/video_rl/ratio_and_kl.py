"""The two terms of GRPO's loss on stored transitions: the ratio of likelihoods (DD-14b to DD-15b) and the KL to
an anchor (DD-17, DD-20).

Shapes: M transitions (video, step) of one network call, U generated elements, S stochastic steps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from wm_nodes.config.video import GrpoConfig
from wm_nodes.core.device import device_of
from wm_nodes.video_model.buffer import RolloutBuffer
from wm_nodes.video_model.kernels import masked_deviation
from wm_nodes.video_model.sampling import RolloutSettings, step_noise
from wm_nodes.video_model.transitions import GaussianTransition, transition
from wm_nodes.video_rl.grpo_math import (
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
    """Transitions of a buffer: videos, and positions among its stochastic steps, int64 (M,), in the host's memory."""

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
    """One pass of the current weights. new: with gradient. old_zeta: of the rollout, (M, U). log_ratio: (M,)."""

    new: GaussianTransition
    old_zeta: Tensor
    log_ratio: Tensor


class GrpoTerms:
    """Ratio and KL of transitions under `model`, and the weights of the anchor where it has its own.

    The anchor is a copy of the parameters that train, nothing else: with LoRA it is as small as the adapter.

    Raises:
        ValueError: the anchor is a model without its adapter, and there is none.
    """

    def __init__(self, model: nn.Module, settings: GrpoConfig, rollout: RolloutSettings) -> None:
        if settings.kl.anchor == "lora_off" and not hasattr(model, "disable_adapter"):
            raise ValueError(
                "kl.anchor lora_off needs a model with a LoRA adapter; add one (video_model.adapters.add_lora), or "
                "take kl.anchor frozen"
            )
        self.model, self.settings, self.rollout = model, settings, rollout
        self.anchor: dict[str, Tensor] = {}
        """Parameters of a frozen or moving anchor by name; empty where the buffer or the bare model is the anchor."""
        if settings.kl.anchor in ("frozen", "moving", "dual"):
            self.move_anchor()

    def move_anchor(self) -> None:
        """Make the model's current parameters the anchor."""
        named = self.model.named_parameters()
        self.anchor = {name: p.detach().clone() for name, p in named if p.requires_grad}

    def ratio(self, buffer: RolloutBuffer, rows: Rows) -> Pass:
        """Run the current weights and take the logarithm of DD-15, or of DD-15b with ratio_norm."""
        cached = self.settings.mask_source == "cached"
        new = self._transition(self.model, buffer, rows, self._mask(buffer, rows) if cached else None)
        old_zeta = _stored_zeta(buffer, rows).to(new.zeta.device)
        return Pass(new, old_zeta, self._log_ratio(new, old_zeta, buffer, rows))

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

    @torch.no_grad()
    def step_weights(self, buffer: RolloutBuffer, video: Tensor) -> Tensor:
        """Return SAGE's equaliser, (S,), from the sensitivity rms_u |d mean / d v| / std of one video (1,)."""
        S = len(buffer.rollout.steps)
        rows = Rows(video.expand(S), torch.arange(S))
        law = self._transition(self.model, buffer, rows, self._mask(buffer, rows))
        return step_equaliser((law.slope / law.std).square().mean(1).sqrt().cpu())

    # internals

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
        mask = self._mask(buffer, rows)
        if self.settings.kl.anchor != "lora_off":
            return self._transition(self._call_anchor, buffer, rows, mask).zeta
        disable: Any = self.model.disable_adapter
        with disable():
            return self._transition(self.model, buffer, rows, mask).zeta

    def _call_anchor(self, *arguments: Any) -> Any:
        """Call the model with the anchor's parameters, while the current ones keep their graph."""
        return functional_call(self.model, self.anchor, arguments)


def _stored_zeta(buffer: RolloutBuffer, rows: Rows) -> Tensor:
    """Return the normalised noise of the rollout, float32 (M, U); drawn again where only seeds are kept."""
    if buffer.rollout.zeta is not None:
        return rows.of(buffer.rollout.zeta).flatten(1).float()
    shape, K = tuple(buffer.rollout.latents.shape[1:]), buffer.condition.num_conditioning
    steps = [buffer.rollout.steps[position] for position in rows.positions.tolist()]
    pairs = zip(rows.videos.tolist(), steps, strict=True)
    noise = torch.cat([step_noise(shape, buffer.rollout.seeds[i : i + 1], k) for i, k in pairs])
    return noise[:, :, K:].flatten(1)
