"""Condition tokens of the world models. Shapes: B batch, T transitions, A action, S state, N tokens, D width, R rows of
text, L words of the longest one."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

NUM_FREQUENCIES = 6


def text_rows(instructions: Sequence[str]) -> Sequence[str]:
    """One row where all instructions of a batch are equal, else one for each."""
    return instructions[:1] if len(set(instructions)) == 1 else instructions


def word_mask(lengths: Sequence[int], device: torch.device) -> Tensor | None:
    """Mask (R, L + 1) of rows of `lengths` words and then a null token, False where a shorter row is padded; None where
    none is."""
    longest = max(lengths)
    if min(lengths) == longest:
        return None
    return torch.tensor([[i < length or i == longest for i in range(longest + 1)] for length in lengths], device=device)


class ScalarTokens(nn.Module):
    """One token per scalar: Fourier features, then a linear map of its own per scalar, then a shared MLP."""

    def __init__(self, num_scalars: int, width: int) -> None:
        super().__init__()
        num_features = 1 + 2 * NUM_FREQUENCIES
        self.weight = nn.Parameter(torch.randn(num_scalars, num_features, width) * num_features**-0.5)
        self.bias = nn.Parameter(torch.randn(num_scalars, width) * 0.5)
        self.mlp = nn.Sequential(nn.SiLU(), nn.Linear(width, width))

    def forward(self, scalars_BTN: Tensor) -> Tensor:
        """Tokens (B, T, N, D) of scalars whose useful range is about [-1, 1]."""
        scalars = scalars_BTN.float()
        phases = scalars.unsqueeze(-1) * (0.5 * torch.pi * 2.0 ** torch.arange(NUM_FREQUENCIES, device=scalars.device))
        features = torch.cat((scalars.unsqueeze(-1), phases.sin(), phases.cos()), -1)
        tokens: Tensor = self.mlp(torch.einsum("btnf,nfd->btnd", features, self.weight) + self.bias)
        return tokens


class ActionCondition(nn.Module):
    """Tokens of one transition: each action dimension, each value of the commanded tool position before and after,
    and a null token.

    The tool positions add no information to RS-1: state t + 1 = clip(state t + max_action a_t) is a function of the
    first state and of a_0 .. a_t.
    """

    def __init__(self, action_dim: int, state_dim: int, width: int) -> None:
        super().__init__()
        self.scalars = ScalarTokens(action_dim + 2 * state_dim, width)
        self.null = nn.Parameter(torch.randn(width) * 0.5)
        self.state_mean: Tensor
        self.state_scale: Tensor
        self.register_buffer("state_mean", torch.zeros(state_dim))
        self.register_buffer("state_scale", torch.ones(state_dim))

    @torch.no_grad()
    def fit_states(self, states_FS: Tensor) -> None:
        """Let recorded states (F, S) span [-1, 1], before any training."""
        self.state_mean.copy_((states_FS.amax(0) + states_FS.amin(0)) / 2)
        self.state_scale.copy_(((states_FS.amax(0) - states_FS.amin(0)) / 2).clamp_min(1e-3))

    def forward(self, actions_BTA: Tensor, states_BTS: Tensor, next_states_BTS: Tensor) -> Tensor:
        """Tokens (B, T, A + 2 S + 1, D); actions in [-1, 1], states in m."""
        before, after = ((s - self.state_mean) / self.state_scale for s in (states_BTS, next_states_BTS))
        tokens = self.scalars(torch.cat((actions_BTA, before, after), -1))
        null = self.null.to(tokens.dtype).expand(*tokens.shape[:2], 1, -1)
        return torch.cat((tokens, null), 2)
