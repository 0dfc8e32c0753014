"""How the measured values of a state change, where no rule says it but the picture does.

Shapes: ... any batch, S tokens, D values per token, A action, P state, M measured values.
"""

import torch
from torch import Tensor, nn


class ScaledChange(nn.Module):
    """What networks share that predict changes of the measured values: shift and scale of states and changes.

    Args:
        measured: which values of a state, see EnvironmentSpec.measured.
        num_changes: of values whose changes are scaled.
    """

    def __init__(self, state_dim: int, measured: tuple[int, ...], num_changes: int) -> None:
        super().__init__()
        self.measured = measured
        self.state_mean: Tensor
        self.state_scale: Tensor
        self.change_scale: Tensor
        self.register_buffer("state_mean", torch.zeros(state_dim))
        self.register_buffer("state_scale", torch.ones(state_dim))
        self.register_buffer("change_scale", torch.ones(num_changes))
        self.columns: Tensor
        self.register_buffer("columns", torch.tensor(measured), persistent=False)  # a captured step may not copy it up

    @torch.no_grad()
    def fit_scale(self, states_FP: Tensor, changes_FP: Tensor) -> None:
        """Set shift and scale from recorded states (F, P) and their changes, before any training."""
        self.state_mean.copy_(states_FP.mean(0))
        self.state_scale.copy_(states_FP.std(0, correction=0).clamp_min(1e-3))
        self.change_scale.copy_(changes_FP.std(0, correction=0).clamp_min(1e-4))

    def moved(self, states_P: Tensor, change_M: Tensor, commanded_P: Tensor) -> Tensor:
        """States (..., P): commanded_P with the measured values of states_P after a change of theirs."""
        return commanded_P.index_copy(-1, self.columns, states_P[..., self.columns] + change_M)


class StateChange(ScaledChange):
    """Reads the change of the measured values in one step off the action, the state before and the frame's mean token.

    Args:
        measured: which values of a state, see EnvironmentSpec.measured.
    """

    HIDDEN = 64

    def __init__(self, action_dim: int, state_dim: int, latent_dim: int, measured: tuple[int, ...]) -> None:
        super().__init__(state_dim, measured, len(measured))
        self.read = nn.Sequential(
            nn.Linear(action_dim + state_dim + latent_dim, self.HIDDEN), nn.SiLU(),
            nn.Linear(self.HIDDEN, self.HIDDEN), nn.SiLU(), nn.Linear(self.HIDDEN, len(measured)),
        )

    def fit_scale(self, states_FP: Tensor, changes_FP: Tensor) -> None:
        """As ScaledChange's; changes (F, P) of all values."""
        super().fit_scale(states_FP, changes_FP[:, self.columns])

    def forward(self, latents_SD: Tensor, actions_A: Tensor, states_P: Tensor) -> Tensor:
        """Change (..., M) in units of change_scale; latents (..., S, D), actions (..., A), states (..., P)."""
        scaled = (states_P - self.state_mean) / self.state_scale
        change: Tensor = self.read(torch.cat((actions_A, scaled, latents_SD.float().mean(-2)), -1))
        return change.float()

    def next_states(self, latents_SD: Tensor, actions_A: Tensor, states_P: Tensor, commanded_P: Tensor) -> Tensor:
        """States (..., P) after the step: commanded_P with the measured values that are predicted."""
        change = self(latents_SD, actions_A, states_P) * self.change_scale
        return self.moved(states_P, change, commanded_P)

    def wanted(self, states_P: Tensor, next_states_P: Tensor) -> Tensor:
        """What forward should have given for recorded states before and after."""
        changed: Tensor = (next_states_P - states_P)[..., self.columns] / self.change_scale
        return changed
