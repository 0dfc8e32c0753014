"""The controller's rule, equal in every environment (RS-9): legal actions, and where they command the tool."""

import numpy as np
import torch
from torch import Tensor

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray


def next_state(states: FloatArray, actions: FloatArray, spec: EnvironmentSpec) -> FloatArray:
    """Commanded tool position (..., S) after actions (..., A): state + scale * action, kept inside the box.

    A state that starts outside the box (a reset pose may) is not pulled in by a zero action.
    """
    moved = states + np.asarray(spec.action_scale, np.float32) * actions
    if spec.state_low:
        low = np.minimum(np.asarray(spec.state_low, np.float32), states)
        high = np.maximum(np.asarray(spec.state_high, np.float32), states)
        moved = np.clip(moved, low, high)
    return moved.astype(np.float32)


def next_state_tensor(
    states_NS: Tensor, actions_NA: Tensor, scale_A: Tensor, box_2S: Tensor | None
) -> Tensor:
    """next_state, to the bit, of tensors on one device. scale_A: the spec's action_scale. box_2S: state_low and
    state_high; None: no box."""
    moved = states_NS + scale_A * actions_NA
    if box_2S is None:
        return moved
    return torch.minimum(
        torch.maximum(moved, torch.minimum(box_2S[0], states_NS)), torch.maximum(box_2S[1], states_NS)
    )


def check_actions(actions: FloatArray, spec: EnvironmentSpec) -> None:
    """Raise ValueError unless actions are (N, A), finite and inside [-1, 1]."""
    expected = (spec.num_envs, spec.action_dim)
    if actions.shape != expected:
        raise ValueError(f"actions must have shape {expected} (num_envs, action_dim), got {actions.shape}")
    if not np.isfinite(actions).all():
        raise ValueError(f"actions must be finite, got {actions[~np.isfinite(actions).all(1)][0].tolist()}")
    if np.abs(actions).max(initial=0.0) > 1.0 + 1e-6:
        worst = actions.flat[np.abs(actions).argmax()]
        raise ValueError(f"actions are normalised to [-1, 1], got {worst}; clip, or rescale by EnvSpec.action_scale")
