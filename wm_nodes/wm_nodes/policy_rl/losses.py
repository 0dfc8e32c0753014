"""Losses of proximal policy optimisation, one value per sample. Shapes: B samples. RS-10b, RS-10c.

Nothing is averaged here: the learner divides by the sample count of the whole minibatch, which may be spread over
several ranks.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

HUBER_DELTA = 10.0


def clipped_policy_loss(logprobs_B: Tensor, old_logprobs_B: Tensor, advantages_B: Tensor, *, clip: float) -> Tensor:
    """Return -min(rho A, clamp(rho, 1 - clip, 1 + clip) A), rho = exp(logprob - old logprob) (RS-10b), shape (B,).

    old_logprobs_B: nats, of the executed action under the policy that acted. clip: > 0.
    """
    ratio_B = torch.exp(logprobs_B - old_logprobs_B)
    clipped_B = ratio_B.clamp(1 - clip, 1 + clip)
    return -torch.minimum(ratio_B * advantages_B, clipped_B * advantages_B)


def value_loss(values_B: Tensor, old_values_B: Tensor, returns_B: Tensor, *, clip: float) -> Tensor:
    """Return the Huber loss of the critic (RS-10c), shape (B,): half the squared error up to HUBER_DELTA, then linear.

    With clip > 0 it is the larger of this loss and that of values kept within clip of old_values_B. clip 0: off.
    """
    plain_B = _huber(values_B - returns_B)
    if clip == 0:
        return plain_B
    limited_B = old_values_B + (values_B - old_values_B).clamp(-clip, clip)
    return torch.maximum(plain_B, _huber(limited_B - returns_B))


def approximate_kl(logprobs_B: Tensor, old_logprobs_B: Tensor) -> Tensor:
    """Return the per-sample estimate (rho - 1) - log rho of KL(old || new), nats; never negative."""
    log_ratio_B = logprobs_B - old_logprobs_B
    return torch.expm1(log_ratio_B) - log_ratio_B


def clip_fraction(logprobs_B: Tensor, old_logprobs_B: Tensor, *, clip: float) -> Tensor:
    """Return 1 where the probability ratio left [1 - clip, 1 + clip], else 0, as floats (B,)."""
    return ((torch.exp(logprobs_B - old_logprobs_B) - 1).abs() > clip).to(logprobs_B.dtype)


def _huber(error_B: Tensor) -> Tensor:
    return F.huber_loss(error_B, torch.zeros_like(error_B), delta=HUBER_DELTA, reduction="none")
