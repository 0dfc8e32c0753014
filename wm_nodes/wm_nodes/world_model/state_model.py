"""What happens to things whose places a state says, without any picture (RS-1g).

Shapes: ... any batch, P state, M measured values, K done heads, J tasks.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from wm_nodes.core.differences import Differences
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.world_model.state_change import ScaledChange, StateChange


def state_sizes(spec: EnvironmentSpec) -> dict[str, Any]:
    """What an action model is told of a spec's state, beside its size."""
    return {"measured": spec.measured, "differences": spec.differences}


class StateModel(ScaledChange):
    """The state after a step, from the two before it and what is commanded, and the done signal of a state.

    Args:
        measured: which values of a state, see EnvironmentSpec.measured; the others are commanded.
        differences: EnvironmentSpec.differences.
    """

    HIDDEN, DONE_HIDDEN = 256, 128
    MOST = 20.0
    """Of a scaled change that the network sees: of what hardly moves, the scale is tiny."""
    exact = True
    """Computes in float32, wherever it is: a success is a matter of millimetres."""

    def __init__(
        self, state_dim: int, measured: tuple[int, ...], differences: Sequence[tuple[int, int]], num_tasks: int,
        num_heads: int,
    ) -> None:
        super().__init__(state_dim, measured, state_dim)
        if not measured:
            raise ValueError("world_model.state_model_iterations needs a state that says where things are, and all of "
                             "this one is commanded; set simulation.object_state, or record what is measured")
        self.seen = Differences(state_dim, differences)
        self.lengths = tuple(i for i in measured if any(i in pair for pair in differences))
        self.num_heads = num_heads
        self.read = _network(self.seen.dim + 2 * state_dim, self.HIDDEN, 3, len(measured))
        seen = self.seen.dim + len(measured)
        self.done = nn.ModuleList(_network(seen, self.DONE_HIDDEN, 2, num_tasks) for _ in range(num_heads))

    def change(self, states_P: Tensor, earlier_P: Tensor, commanded_P: Tensor) -> Tensor:
        """Change (..., M) of the measured values, in multiples of change_scale. earlier_P: states a step before; at the
        start the same. commanded_P: states after the step, of which the commanded values count."""
        with torch.autocast(states_P.device.type, enabled=False):
            wanted = (commanded_P - states_P).index_fill(-1, self.columns, 0.0)
            seen = self._scaled(states_P), self._moves(wanted), self._moves(states_P - earlier_P)
            found: Tensor = self.read(torch.cat(seen, -1))
            return found

    def next_states(self, states_P: Tensor, earlier_P: Tensor, commanded_P: Tensor) -> Tensor:
        """States (..., P) after the step: commanded_P with the measured values that are predicted."""
        change = self.change(states_P, earlier_P, commanded_P) * self.change_scale[self.columns]
        return self.moved(states_P, change, commanded_P)

    def done_logits(self, states_P: Tensor, earlier_P: Tensor) -> Tensor:
        """(..., K, J), of the states; earlier_P: a step before, so that what still moves is not taken
        for at rest."""
        with torch.autocast(states_P.device.type, enabled=False):
            moved = self._moves(states_P - earlier_P)[..., self.columns]
            seen = torch.cat((self._scaled(states_P), moved), -1)
            return torch.stack([head(seen) for head in self.done], -2)

    def _moves(self, change_P: Tensor) -> Tensor:
        return (change_P / self.change_scale).clamp(-self.MOST, self.MOST)

    def _scaled(self, states_P: Tensor) -> Tensor:
        seen: Tensor = self.seen((states_P - self.state_mean) / self.state_scale, states_P)
        return seen


class MovesStates(Protocol):
    """An action model."""

    @property
    def state_model(self) -> StateModel | None: ...

    @property
    def state_change(self) -> StateChange | None: ...


def next_states(
    model: MovesStates, latents_SD: Tensor, actions_A: Tensor, states_P: Tensor, earlier_P: Tensor, commanded_P: Tensor
) -> Tensor:
    """States (..., P) after a step, by whichever part of the model predicts them; commanded_P where none does."""
    if model.state_model is not None:
        return model.state_model.next_states(states_P, earlier_P, commanded_P)
    if model.state_change is not None:
        return model.state_change.next_states(latents_SD, actions_A, states_P, commanded_P)
    return commanded_P


def _network(inputs: int, hidden: int, depth: int, outputs: int) -> nn.Sequential:
    layers = [layer for _ in range(depth - 1) for layer in (nn.Linear(hidden, hidden), nn.SiLU())]
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), *layers, nn.Linear(hidden, outputs))
