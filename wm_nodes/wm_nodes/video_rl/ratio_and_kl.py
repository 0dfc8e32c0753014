"""The two terms of GRPO's loss on stored transitions: the objective of the ratio of likelihoods (DD-12, DD-14 to DD-16)
and the KL to an anchor (DD-17, DD-17a, DD-20).

Shapes: M transitions (video, step) of one network call, U generated elements, S stochastic steps. A transition is
stored as its normalised noise zeta = (x_s - mean) / std, taken after x_s was rounded to its storage type; with std
cached, both are functions of the stored zeta and of the zeta that the current weights give to the same x_s:

    log p_new - log p_old = mean_u[(zeta_old^2 - zeta_new^2) / 2]      KL = mean_u[(zeta_old - zeta_new)^2 / 2]

so both are exactly 0 while the weights have not moved, and free of the cancellation of two large log-probabilities.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from wm_nodes.config.video import GrpoConfig, RolloutConfig
from wm_nodes.core.device import device_of
from wm_nodes.video_model import RolloutBuffer, StepContext, flow_times, guided_velocity, select_steps, step
from wm_nodes.video_model.kernels import with_conditioning
from wm_nodes.video_model.sampling import normalised_noise


def log_ratio(new_zeta_MU: Tensor, old_zeta_MU: Tensor, weight_MU: Tensor | float = 1.0) -> Tensor:
    """Return the log of DD-15, (M,): mean over elements of weight (zeta_old - zeta_new)(zeta_old + zeta_new) / 2.

    weight (DD-14c): 1 the full likelihood; 2 std^2 CPS's, which has no 1 / 2 std^2.
    """
    return (0.5 * weight_MU * (old_zeta_MU - new_zeta_MU) * (old_zeta_MU + new_zeta_MU)).mean(1)


def clipped_objective(log_ratio_M: Tensor, advantages_M: Tensor, clip: float) -> Tensor:
    """Return DD-16 per transition, to be maximised: min(r A, clamp(r, 1 - clip, 1 + clip) A)."""
    ratio = log_ratio_M.exp()
    return torch.minimum(ratio * advantages_M, ratio.clamp(1 - clip, 1 + clip) * advantages_M)


def clip_tails(log_ratio_M: Tensor, clip: float) -> tuple[Tensor, Tensor]:
    """Return how many transitions have a ratio below 1 - clip, and above 1 + clip, float64 ()."""
    ratio = log_ratio_M.exp()
    return (ratio < 1 - clip).sum().double(), (ratio > 1 + clip).sum().double()


def mean_kl(new_zeta_MU: Tensor, target_zeta_MU: Tensor) -> Tensor:
    """Return DD-17, (M,): the KL of Gaussians of one std, mean over elements; with the buffer's zeta it is DD-20."""
    return 0.5 * (target_zeta_MU - new_zeta_MU).square().mean(1)


def log_space_kl(log_ratio_M: Tensor) -> Tensor:
    """Return the k2 estimate (log r)^2 / 2, (M,); DD-17a; far weaker than DD-17."""
    return 0.5 * log_ratio_M.square()


@dataclass(frozen=True)
class Rows:
    """What one optimizer step trains on, int64 (M,), in the host's memory."""

    videos: Tensor
    """Of a buffer."""
    positions: Tensor
    """Among its stochastic steps; with objective nft among the times of a video."""

    def __len__(self) -> int:
        return len(self.videos)

    def part(self, index: Tensor) -> "Rows":
        return Rows(self.videos[index], self.positions[index])

    def of(self, stored: Tensor, positions: Tensor | None = None) -> Tensor:
        """Return the rows (M, ...) of a tensor (N, S, ...) where that lies; positions: others than their own."""
        places = self.positions if positions is None else positions
        index = torch.stack([self.videos, places]).to(stored.device)
        return stored[index[0], index[1]]


class GaussianTransition(NamedTuple):
    """The Gaussian of M stored transitions under the weights of now."""

    zeta: Tensor
    """(x_s - mean) / std, (M, U), with gradient."""
    std: Tensor
    """(M, U), without."""


class LossTerms(NamedTuple):
    """What the loss is made of, (M,), with gradient."""

    objective: Tensor
    """To be maximised."""
    kl: Tensor
    """To the anchor; 0 where it has no weight, and with objective nft."""
    log_ratio: Tensor | None
    """Of DD-15; None with objective nft."""

    def sums(self, clip: float) -> Tensor:
        """Return the sums of objective, kl and ratio, and the counts of ratios beyond either clip, float64 (5,); NaN
        where there is no ratio."""
        sums = torch.full((5,), torch.nan, dtype=torch.float64, device=self.kl.device)
        sums[0], sums[1] = self.objective.detach().sum().double(), self.kl.detach().sum().double()
        if self.log_ratio is not None:
            ratio = self.log_ratio.detach()
            sums[2:] = torch.stack([ratio.exp().sum().double(), *clip_tails(ratio, clip)])
        return sums


class Terms:
    """A loss on `model` that may need other weights of it: copies of the parameters that train, nothing else. With LoRA
    they are as small as the adapter."""

    def __init__(self, model: nn.Module, settings: GrpoConfig, rollout: RolloutConfig, seed: int) -> None:
        self.model, self.settings, self.rollout, self.seed = model, settings, rollout, seed
        self.anchor: dict[str, Tensor] = {}
        """Parameters of a frozen anchor by name; empty where the buffer or the bare model is the anchor."""

    def begin(self) -> None:
        """Called before the first update on a buffer."""

    def trained(self) -> dict[str, Tensor]:
        """Copy the model's parameters that train."""
        return {name: p.detach().clone() for name, p in trained_parameters(self.model)}

    def at(self, weights: dict[str, Tensor]) -> Callable[..., Any]:
        """The model with other weights, while the current ones keep their graph."""
        return lambda *arguments: functional_call(self.model, weights, arguments)


class GrpoTerms(Terms):
    """Objective and KL of transitions by the ratio of their likelihoods under `model`.

    Raises:
        ValueError: the anchor is a model without its adapter, and there is none.
    """

    def __init__(self, model: nn.Module, settings: GrpoConfig, rollout: RolloutConfig, seed: int) -> None:
        if settings.kl.anchor == "lora_off" and not hasattr(model, "disable_adapter"):
            raise ValueError(
                "kl.anchor lora_off needs a model with a LoRA adapter; add one (video_model.adapters.add_lora), or "
                "take kl.anchor frozen"
            )
        super().__init__(model, settings, rollout, seed)
        if settings.kl.anchor in ("frozen", "dual"):
            self.anchor = self.trained()

    def choose(self, buffer: RolloutBuffer) -> Tensor:
        """Return which transitions train, bool (N, S)."""
        return select_steps(
            len(buffer.rollout.steps), len(buffer), fraction=self.settings.step_fraction, seed=self.seed,
            iteration=buffer.iteration,
        )

    def compute(self, buffer: RolloutBuffer, rows: Rows, signals_M: Tensor, version: int) -> LossTerms:
        """Run the current weights; return DD-16 of DD-15, and the KL.

        Args:
            signals_M: the advantages. version: optimizer steps made, for the dual anchor.
        """
        new = self.transition(self.model, buffer, rows)
        old_zeta = rows.of(buffer.rollout.zeta).flatten(1).float().to(new.zeta.device)
        ratio = self._log_ratio(new, old_zeta)
        objective = clipped_objective(ratio, signals_M, self.settings.clip)
        return LossTerms(objective, self.kl(new, old_zeta, buffer, rows, version), ratio)

    def kl(
        self, new: GaussianTransition, old_zeta: Tensor, buffer: RolloutBuffer, rows: Rows, version: int
    ) -> Tensor:
        """Return DD-17 or DD-20 per transition, (M,). old_zeta: of the rollout, (M, U)."""
        settings, kl = self.settings.kl, torch.zeros(len(rows), device=old_zeta.device)
        if settings.beta == 0:
            return kl
        if settings.anchor in ("buffer", "dual"):
            kl = kl + self._distance(new, old_zeta)
        due = settings.anchor in ("frozen", "lora_off") or version % settings.dual_every == 0
        if settings.anchor != "buffer" and due:
            with torch.no_grad(), self.anchored() as model:
                target = self.transition(model, buffer, rows).zeta
            kl = kl + self._distance(new, target)
        return kl

    @contextmanager
    def anchored(self) -> Iterator[Callable[..., Any]]:
        """Give the model as it is at the anchor."""
        if self.settings.kl.anchor != "lora_off":
            yield self.at(self.anchor)
            return
        disable: Any = self.model.disable_adapter
        with disable():
            yield self.model

    def transition(self, model: Callable[..., Any], buffer: RolloutBuffer, rows: Rows) -> GaussianTransition:
        """Return the normalised noise that leads the rows from x_t to x_s under `model` (DD-1)."""
        device, rollout = device_of(self.model), buffer.rollout
        times = flow_times(self.rollout.num_steps, self.rollout.shift)
        steps = torch.tensor(rollout.steps)[rows.positions]
        where = torch.tensor([rollout.state_steps.index(k) for k in rollout.steps])[rows.positions]
        x_t, x_s = (rows.of(rollout.states, places).to(device).float() for places in (where, where + 1))
        t, s = times[torch.stack([steps, steps + 1])].to(device)
        condition = buffer.condition.rows(rows.videos.to(buffer.condition.frames.device)).to(device)
        context = StepContext(condition.frames.float(), float(times[1]), rows.of(rollout.mask).to(device))
        x, K = with_conditioning(x_t, context.conditioning), condition.num_conditioning
        v = guided_velocity(model, x, t, condition, self.rollout.cfg).float()
        law = step(x, v, t, s, context, self.rollout.sampler)
        zeta = normalised_noise(x_s, law, K)
        return GaussianTransition(zeta.flatten(1), law.std[:, :, K:].expand_as(zeta).flatten(1))

    # internals

    def _log_ratio(self, new: GaussianTransition, old_zeta: Tensor) -> Tensor:
        return log_ratio(
            new.zeta, old_zeta, 2 * new.std.square() if self.settings.logprob_weight == "cps" else 1.0
        )

    def _distance(self, new: GaussianTransition, target_zeta: Tensor) -> Tensor:
        if self.settings.kl.mode == "logk2":
            return log_space_kl(self._log_ratio(new, target_zeta))
        return mean_kl(new.zeta, target_zeta)


def trained_parameters(model: nn.Module) -> Iterator[tuple[str, Tensor]]:
    return ((name, p) for name, p in model.named_parameters() if p.requires_grad)
