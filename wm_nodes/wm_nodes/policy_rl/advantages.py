"""Advantages and value targets over rollouts of lock-steps. Shapes: T time, N environments, K groups of G neighbouring
environments, N = K G. RS-10a, RS-10e.
"""

from dataclasses import dataclass

import torch
from torch import Tensor


def gae(
    rewards_TN: Tensor,
    values_TN: Tensor,
    next_values_TN: Tensor,
    terminated_TN: Tensor,
    truncated_TN: Tensor,
    valid_TN: Tensor,
    *,
    gamma: float,
    lambda_: float,
) -> tuple[Tensor, Tensor]:
    """Return (advantages_TN, returns_TN) by generalised advantage estimation (RS-10a), working back from the last step.

    delta_t = r_t + gamma (1 - terminated_t) V(x_{t+1}) - V(x_t);  A_t = delta_t + gamma lambda c_t A_{t+1};
    c_t = 1 where step t + 1 continues the same episode. Returns are A_t + V(x_t). Both are 0 where valid is False.

    Args:
        rewards_TN: reward on the observation that step t reached; may be NaN where valid is False.
        values_TN: critic value of the observation before step t.
        next_values_TN: critic value of the observation that step t reached (not of the one after a reset).
        terminated_TN: bool, the task is over, done or failed: no value beyond it.
        truncated_TN: bool, ended without success: the sum stops there; bootstraps from next_values unless terminated.
        valid_TN: bool; an invalid step is skipped, and a sum that would run through it stops before it.
        gamma: discount, [0, 1]. lambda_: 0 gives one-step TD errors, 1 sums to the end of the episode.

    Raises:
        ValueError: shapes differ, or a valid reward or value is not finite.
    """
    _check_equal_shapes(rewards_TN, values_TN, next_values_TN, terminated_TN, truncated_TN, valid_TN)
    terminated_TN, truncated_TN, valid_TN = terminated_TN.bool(), truncated_TN.bool(), valid_TN.bool()
    zeros_TN = torch.zeros_like(values_TN)
    bootstrap_TN = torch.where(terminated_TN, zeros_TN, next_values_TN)
    deltas_TN = torch.where(valid_TN, rewards_TN + gamma * bootstrap_TN - values_TN, zeros_TN)
    if not bool(torch.isfinite(deltas_TN).all()):
        t, n = (int(i) for i in torch.nonzero(~torch.isfinite(deltas_TN))[0])
        raise ValueError(
            f"step {t} of environment {n} is valid, but its reward ({float(rewards_TN[t, n])}) or value "
            f"({float(values_TN[t, n])} -> {float(next_values_TN[t, n])}) is not finite; mark it valid=False"
        )
    advantages_TN = torch.zeros_like(values_TN)
    ahead_N = torch.zeros_like(values_TN[0])
    ahead_valid_N = torch.zeros_like(valid_TN[0])
    for t in reversed(range(rewards_TN.shape[0])):
        continues_N = ahead_valid_N & ~terminated_TN[t] & ~truncated_TN[t]
        ahead_N = deltas_TN[t] + gamma * lambda_ * torch.where(continues_N, ahead_N, zeros_TN[t])
        ahead_N = torch.where(valid_TN[t], ahead_N, zeros_TN[t])
        ahead_valid_N = valid_TN[t]
        advantages_TN[t] = ahead_N
    return advantages_TN, torch.where(valid_TN, advantages_TN + values_TN, zeros_TN)


@dataclass(frozen=True)
class GroupAdvantages:
    """Advantages of whole episodes against their groups."""

    advantages_TN: Tensor
    """float32 (T, N), 0 where counted_TN is False."""
    counted_TN: Tensor
    """bool (T, N), the steps to train on."""
    groups_without_signal: int
    """Groups of equal returns, or of a single one."""
    episodes_without_return: int
    """Episodes with an invalid step, left out."""


def group_advantages(
    rewards_TN: Tensor, terminated_TN: Tensor, truncated_TN: Tensor, valid_TN: Tensor, *, group_size: int,
    by_std: bool = True, leave_one_out: bool = False,
) -> GroupAdvantages:
    """Compare each environment's first episode with those of its group, all begun at the same start (RS-10e).

    R_i = sum of the rewards of episode i up to its end or the rollout's; A_i = (R_i - mean_g R) / std_g R, the same for
    all steps of the episode. An episode with an invalid step has no return and is left out; its group is the others.
    A group with std_g < 1e-6 max(1, |mean_g|) has advantages 0.

    Args:
        rewards_TN: as of gae. group_size: G; environments i G .. i G + G - 1 are a group.
        by_std: False: do not divide by the standard deviation (population, float64).
        leave_one_out: the mean is that of the group's other episodes.

    Raises:
        ValueError: shapes differ, or the rewards of an episode are valid and not finite.
    """
    _check_equal_shapes(rewards_TN, terminated_TN, truncated_TN, valid_TN)
    ended_TN = (terminated_TN.bool() | truncated_TN.bool()).int()
    first_TN = ended_TN.cumsum(0) - ended_TN == 0
    known_N = (valid_TN.bool() | ~first_TN).all(0)
    counted_TN = first_TN & known_N
    returns_N = torch.where(counted_TN, rewards_TN, 0.0).double().sum(0)
    if not bool(torch.isfinite(returns_N).all()):
        n = int(torch.nonzero(~torch.isfinite(returns_N))[0])
        raise ValueError(
            f"the rewards of environment {n} are valid and sum to {float(returns_N[n])}; mark the missing valid=False"
        )
    returns_KG, known_KG = (column.view(-1, group_size) for column in (returns_N, known_N))
    counts_K1 = known_KG.sum(1, keepdim=True)
    means_K1 = returns_KG.sum(1, keepdim=True) / counts_K1.clamp(min=1)
    deviations_KG = torch.where(known_KG, returns_KG - means_K1, 0.0)
    stds_K1 = (deviations_KG.square().sum(1, keepdim=True) / counts_K1.clamp(min=1)).sqrt()
    differs_K1 = stds_K1 >= 1e-6 * means_K1.abs().clamp(min=1)
    if leave_one_out:  # R_i - (sum_g R - R_i) / (n - 1)
        deviations_KG = deviations_KG * counts_K1 / (counts_K1 - 1).clamp(min=1)
    scales_K1 = torch.where(differs_K1 & by_std, stds_K1, 1.0)
    advantages_N = torch.where(differs_K1, deviations_KG / scales_K1, 0.0).flatten().float()
    return GroupAdvantages(
        torch.where(counted_TN, advantages_N, 0.0), counted_TN, int((~differs_K1).sum()), int((~known_N).sum())
    )


def masked_normalise(values: Tensor, mask: Tensor, *, epsilon: float = 1e-5, floor: float = 0.0) -> Tensor:
    """Return (values - mean) / (max(std, floor) + epsilon) over the entries where mask is True, and 0 elsewhere.

    The standard deviation is the population one, so a single entry gives 0.
    """
    _check_equal_shapes(values, mask)
    mask = mask.bool()
    if not bool(mask.any()):
        return torch.zeros_like(values)
    chosen = values[mask]
    normalised = (values - chosen.mean()) / (chosen.std(correction=0).clamp(min=floor) + epsilon)
    return torch.where(mask, normalised, torch.zeros_like(values))


def explained_variance(values: Tensor, returns: Tensor, mask: Tensor) -> float:
    """Return 1 - Var(returns - values) / Var(returns) over mask; 1 is perfect, 0 as good as a constant.

    NaN when fewer than two entries count or all returns are equal: there is nothing to explain.
    """
    _check_equal_shapes(values, returns, mask)
    mask = mask.bool()
    if int(mask.sum()) < 2:
        return float("nan")
    spread = returns[mask].var(correction=0)
    if float(spread) == 0.0:
        return float("nan")
    return float(1 - (returns[mask] - values[mask]).var(correction=0) / spread)


def _check_equal_shapes(*tensors: Tensor) -> None:
    shapes = [tuple(tensor.shape) for tensor in tensors]
    if len(set(shapes)) != 1:
        raise ValueError(f"all arguments must have one shape, got {shapes}")
