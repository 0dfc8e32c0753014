"""How far apart the things are that a state says the places of. Shapes: ... any batch, P state, K pairs of values."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

NEAR_M = 0.1
"""Differences are divided by it."""


class Differences(nn.Module):
    """Adds to a scaled state its differences, in multiples of NEAR_M. In the scale of a whole table a network has to
    find a difference of a centimetre by itself, and of few demonstrations it does not.

    Args:
        state_dim: P.
        pairs: EnvironmentSpec.differences; none: the state stays as it is.
    """

    def __init__(self, state_dim: int, pairs: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        self.dim = state_dim + len(pairs)
        self.pairs: Tensor
        self.register_buffer("pairs", torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).T, persistent=False)

    def forward(self, scaled_P: Tensor, states_P: Tensor) -> Tensor:
        """(..., P + K) of a state, scaled and as it is."""
        if not self.pairs.numel():
            return scaled_P
        apart = (states_P[..., self.pairs[0]] - states_P[..., self.pairs[1]]) / NEAR_M
        return torch.cat((scaled_P, apart.to(scaled_P.dtype)), -1)
