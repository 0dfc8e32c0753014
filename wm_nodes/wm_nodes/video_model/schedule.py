"""Times of a flow-matching sampler (DD-3a), which of its steps are stochastic (DD-25, the window of Mix-GRPO), and
which of those train (DD-26). t = 1 is pure noise, t = 0 is data; x_t = (1 - t) x_0 + t eps.

Steps are numbered 0 to T - 1; the last one (s = 0) is never stochastic, so T - 1 steps can be.
"""

import torch
from torch import Tensor

from wm_nodes.config.video import WindowConfig
from wm_nodes.core.seeding import torch_stream


def flow_times(num_steps: int, shift: float = 1.0) -> Tensor:
    """Return the times 1 = t_0 > t_1 > ... > t_T = 0, float64 (num_steps + 1,).

    Args:
        shift: a of t <- a t / (1 + (a - 1) t); 1 leaves the times equally spaced, 3 is Wan's, 5 Cosmos's and Kairos's.
    """
    times = torch.linspace(1.0, 0.0, num_steps + 1, dtype=torch.float64)
    return shift * times / (1 + (shift - 1) * times)


def stochastic_steps(num_steps: int, settings: WindowConfig, iteration: int) -> list[int]:
    """Return the stochastic steps of one iteration; never empty unless T = 1, where no step can be.

    The window's start is kept at or below T - 1 - size, so it never shrinks or runs empty near the end; a window of
    T - 1 steps or more is all of them.
    """
    last_start = num_steps - 1 - settings.size
    if settings.strategy == "all" or last_start <= 0:
        return list(range(num_steps - 1))
    start = (iteration // settings.period) % (last_start + 1)
    return list(range(start, start + settings.size))


def select_steps(num_steps: int, num_samples: int, *, fraction: float, seed: int, iteration: int) -> Tensor:
    """Return which of num_steps stochastic steps train, bool (N, S): floor(fraction S) per sample without replacement.

    At least one step stays.

    Raises:
        ValueError: no step is stochastic.
    """
    if not num_steps:
        raise ValueError("no step can train: none is stochastic; take more sampler steps")
    chosen = torch.zeros(num_samples, num_steps, dtype=torch.bool)
    count = max(1, int(fraction * num_steps))
    for sample in range(num_samples):
        generator = torch_stream(seed, "step_selection", iteration, sample)
        chosen[sample, torch.randperm(num_steps, generator=generator)[:count]] = True
    return chosen
