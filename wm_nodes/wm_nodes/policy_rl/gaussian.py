"""Diagonal Gaussian over actions. Shapes: B samples, A action. RS-10d.

Actions are executed inside [-1, 1]. The sample is clamped first and the plain Gaussian density is taken at the clamped
action, when acting and when learning alike; no tanh squashing, no mass at the limits. The ratio of two such densities
at one executed action is what the policy gradient needs, and only the executed action has to be stored.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class DiagonalGaussian:
    """mean_BA: (B, A). log_std_A: (A,), the same for every sample. Both in normalised action units."""

    mean_BA: Tensor
    log_std_A: Tensor

    def executed(self, noise_BA: Tensor | None) -> Tensor:
        """Return the action to execute, (B, A) in [-1, 1]: clamp(mean + std noise), or clamp(mean) without noise."""
        actions_BA = self.mean_BA if noise_BA is None else self.mean_BA + self.log_std_A.exp() * noise_BA
        return actions_BA.clamp(-1.0, 1.0)

    def logprob(self, actions_BA: Tensor) -> Tensor:
        """Return log N(action; mean, std^2) summed over A, nats, (B,)."""
        scaled_BA = (actions_BA - self.mean_BA) * torch.exp(-self.log_std_A)
        return (-0.5 * scaled_BA.square() - self.log_std_A - _LOG_SQRT_2PI).sum(-1)

    def entropy(self) -> Tensor:
        """Return sum_a (log std_a + log sqrt(2 pi e)), nats, (B,); equal for all samples."""
        return (self.log_std_A + 0.5 + _LOG_SQRT_2PI).sum().expand(self.mean_BA.shape[0])

    def kl(self, other: "DiagonalGaussian") -> Tensor:
        """Return KL(self || other) in closed form (RS-10d), nats, (B,).

        sum_a log(s2 / s1) + (s1^2 + (m1 - m2)^2) / (2 s2^2) - 1/2
        """
        log_ratio_A = other.log_std_A - self.log_std_A
        inverse_A = torch.exp(-other.log_std_A)
        spread_A = 0.5 * torch.exp(-2 * log_ratio_A)
        shift_BA = 0.5 * ((self.mean_BA - other.mean_BA) * inverse_A).square()
        return (log_ratio_A + spread_A + shift_BA - 0.5).sum(-1)
