"""Advantages and value targets over rollouts of lock-steps. Shapes: T time, N environments. RS-10a."""

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
        terminated_TN: bool, the task is over: no value beyond it.
        truncated_TN: bool, cut by time: bootstraps from next_values, and the sum stops there.
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


def masked_normalise(values: Tensor, mask: Tensor, *, epsilon: float = 1e-5) -> Tensor:
    """Return (values - mean) / (std + epsilon) over the entries where mask is True, and 0 elsewhere.

    The standard deviation is the population one, so a single entry gives 0.
    """
    _check_equal_shapes(values, mask)
    mask = mask.bool()
    if not bool(mask.any()):
        return torch.zeros_like(values)
    chosen = values[mask]
    normalised = (values - chosen.mean()) / (chosen.std(correction=0) + epsilon)
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
