"""Which sampler steps are stochastic (DD-25: windows of Mix-GRPO and Flow-GRPO-Fast), and which of them train (DD-26).

Steps are numbered 0 to T - 1; the last one (s = 0) is never stochastic, so T - 1 steps can be.
"""

import torch
from torch import Tensor

from wm_nodes.config.video import WindowConfig
from wm_nodes.core.seeding import numpy_stream, torch_stream


def stochastic_steps(num_steps: int, settings: WindowConfig, iteration: int, seed: int) -> list[int]:
    """Return the stochastic steps of one iteration; never empty unless T = 1, where no step can be.

    The window's start is kept at or below T - 1 - size, so it never shrinks or runs empty near the end; a window of
    T - 1 steps or more is all of them.
    """
    last_start = num_steps - 1 - settings.size
    if settings.strategy == "all" or last_start <= 0:
        return list(range(num_steps - 1))
    if settings.strategy in ("random", "fast"):
        high = last_start if settings.strategy == "random" else min(last_start, max(0, num_steps // 2 - settings.size))
        start = int(numpy_stream(seed, "sde_window", iteration).integers(high + 1))
    else:
        start = (iteration // settings.period) % (last_start + 1)
    return list(range(start, start + settings.size))


def select_steps(
    times: Tensor, stochastic: list[int], num_samples: int, *, fraction: float, min_s: float, seed: int, iteration: int
) -> Tensor:
    """Return which of the stochastic steps train, bool (N, S): floor(fraction S) per sample without replacement.

    At least one step stays. Steps that end below min_s never train.
    """
    usable = torch.tensor([float(times[k + 1]) >= min_s for k in stochastic], dtype=torch.bool)
    if not stochastic or not bool(usable.any()):
        raise ValueError(
            f"no step can train: {len(stochastic)} stochastic steps, none of which ends at or above s = {min_s}; "
            f"take more sampler steps, or lower grpo.min_s"
        )
    S, candidates = len(stochastic), torch.nonzero(usable).flatten()
    chosen = torch.zeros(num_samples, S, dtype=torch.bool)
    count = min(len(candidates), max(1, int(fraction * S)))
    for sample in range(num_samples):
        generator = torch_stream(seed, "step_selection", iteration, sample)
        order = torch.randperm(len(candidates), generator=generator)
        chosen[sample, candidates[order[:count]]] = True
    return chosen
