"""Times of a flow-matching sampler (DD-3a). t = 1 is pure noise, t = 0 is data; x_t = (1 - t) x_0 + t eps."""

import torch
from torch import Tensor


def flow_times(num_steps: int, shift: float = 1.0) -> Tensor:
    """Return the times 1 = t_0 > t_1 > ... > t_T = 0, float64 (num_steps + 1,).

    Args:
        shift: a of t <- a t / (1 + (a - 1) t); 1 leaves the times equally spaced, 3 is Wan's, 5 Cosmos's and Kairos's.

    Raises:
        ValueError: fewer than one step, or a shift that is not positive.
    """
    if num_steps < 1:
        raise ValueError(f"num_steps must be >= 1, got {num_steps}")
    if not shift > 0:
        raise ValueError(f"shift must be > 0, got {shift}; 1 means none")
    times = torch.linspace(1.0, 0.0, num_steps + 1, dtype=torch.float64)
    return shift * times / (1 + (shift - 1) * times)
