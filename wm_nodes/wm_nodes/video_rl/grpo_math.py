"""Probability ratios, objective and KL of GRPO over Gaussian sampler steps. DD-12, DD-14 to DD-17a.

Shapes: M transitions, each a (video, step) pair; U generated elements of one latent video. A transition is stored as
its normalised noise zeta = (x_s - mean) / std, taken after x_s was rounded to its storage type; with std cached, every
quantity here is a function of the stored zeta and of the zeta that the current weights give to the same x_s:

    log p_new - log p_old = mean_u[(zeta_old^2 - zeta_new^2) / 2]      KL = mean_u[(zeta_old - zeta_new)^2 / 2]

so both are exactly 0 while the weights have not moved, and free of the cancellation of two large log-probabilities.
"""

import math

import torch
from torch import Tensor


def gaussian_logprob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return DD-14: the mean over elements of DD-12, log N(x; mean, std^2), per row of (M, U), nats per element."""
    return (-0.5 * ((x - mean) / std).square() - std.log() - 0.5 * math.log(2 * math.pi)).mean(1)


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
