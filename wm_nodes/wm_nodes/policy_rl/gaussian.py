"""Diagonal Gaussian over actions, censored at the limits. Shapes: B samples, A action. RS-10d.

Actions are executed inside [-1, 1]. What is drawn beyond a limit is executed at the limit, where the likelihood is the
mass of the Gaussian's tail beyond it; inside it is the Gaussian's density. So the score of the executed action has mean
0, as the policy gradient needs, and only the executed action has to be stored. Of a two-valued action, both limits are
at 0: all that is drawn below is executed as -1, the rest as 1.
"""

import math
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor
from torch.special import log_ndtr

LIMIT = 1.0
"""Actions are executed in [-LIMIT, LIMIT], normalised action units."""
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class DiagonalGaussian:
    """See above; in normalised action units."""

    mean_BA: Tensor
    """(B, A), of the Gaussian, not of the executed actions."""
    log_std_A: Tensor
    """(A,), the same for every sample."""
    two_valued_A: Tensor | None = None
    """bool (A,); None: no action is."""

    def executed(self, noise_BA: Tensor | None) -> Tensor:
        """Return the action to execute, (B, A) in [-1, 1]: clamp(mean + std noise), or clamp(mean) without noise; of
        two-valued ones, -1 or 1."""
        actions_BA = self.mean_BA if noise_BA is None else self.mean_BA + self.log_std_A.exp() * noise_BA
        inside_BA = actions_BA.clamp(-LIMIT, LIMIT)
        if self.two_valued_A is None:
            return inside_BA
        return torch.where(self.two_valued_A, 2.0 * (actions_BA >= 0) - 1.0, inside_BA)

    def logprob(self, actions_BA: Tensor) -> Tensor:
        """Return the log likelihood of executed actions summed over A, nats, (B,): log N(action; mean, std^2) inside
        the limits, log Phi(-(1 -+ mean) / std) at them."""
        scaled_BA = (actions_BA - self.mean_BA) * torch.exp(-self.log_std_A)
        density_BA = -0.5 * scaled_BA.square() - self.log_std_A - _LOG_SQRT_2PI
        tail_BA = log_ndtr((actions_BA * self.mean_BA - self._limit_A) * torch.exp(-self.log_std_A))  # where it is +-1
        return torch.where(actions_BA.abs() >= LIMIT, tail_BA, density_BA).sum(-1)

    def entropy(self) -> Tensor:
        """Return -sum_a E[log likelihood], nats, (B,), of the mass at both limits and the density between them."""
        return -self._expected(self)

    def kl(self, other: "DiagonalGaussian") -> Tensor:
        """Return KL(self || other) of the executed actions in closed form (RS-10d), nats, (B,)."""
        return self._expected(self) - self._expected(other)

    def _expected(self, other: "DiagonalGaussian") -> Tensor:
        """E[log likelihood under `other`] of this policy's executed actions, (B,).

        With z = (x - m) / s between a = (-limit - m) / s and b = (limit - m) / s: mass Z = Phi(b) - Phi(a), E[z] =
        phi(a) - phi(b), E[z^2] = Z + a phi(a) - b phi(b).
        """
        low_BA, high_BA = ((sign * self._limit_A - self.mean_BA) * torch.exp(-self.log_std_A) for sign in (-1, 1))
        phi_low_BA, phi_high_BA = (torch.exp(-0.5 * z.square() - _LOG_SQRT_2PI) for z in (low_BA, high_BA))
        below_BA, above_BA = self._log_below_BA.exp(), self._log_above_BA.exp()
        inside_BA = (1 - below_BA - above_BA).clamp(min=0)
        first_BA = phi_low_BA - phi_high_BA
        second_BA = (inside_BA + low_BA * phi_low_BA - high_BA * phi_high_BA).clamp(min=0)
        scale_A = torch.exp(self.log_std_A - other.log_std_A)
        shift_BA = (self.mean_BA - other.mean_BA) * torch.exp(-other.log_std_A)
        squares_BA = scale_A.square() * second_BA + 2 * scale_A * shift_BA * first_BA + shift_BA.square() * inside_BA
        tails_BA = below_BA * other._log_below_BA + above_BA * other._log_above_BA
        return (tails_BA - inside_BA * (other.log_std_A + _LOG_SQRT_2PI) - 0.5 * squares_BA).sum(-1)

    @property
    def _limit_A(self) -> Tensor | float:
        """Beyond it an action is executed at its limit."""
        return LIMIT if self.two_valued_A is None else LIMIT * ~self.two_valued_A

    @property
    def _log_below_BA(self) -> Tensor:
        return cast(Tensor, log_ndtr((-self._limit_A - self.mean_BA) * torch.exp(-self.log_std_A)))

    @property
    def _log_above_BA(self) -> Tensor:
        return cast(Tensor, log_ndtr((self.mean_BA - self._limit_A) * torch.exp(-self.log_std_A)))
