"""The controller's rule, equal in every environment (RS-9): legal actions, and where they command the tool."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from wm_nodes.core.action_spaces import POSE
from wm_nodes.core.rotations import multiply, to_quaternion, to_vector
from wm_nodes.core.specs import EnvironmentSpec, of_columns
from wm_nodes.core.types import FloatArray


def moves_pose(spec: EnvironmentSpec) -> bool:
    """Whether actions turn the tool and command the gripper too."""
    return spec.action_names == POSE.action_names


def next_state(states: FloatArray, actions: FloatArray, spec: EnvironmentSpec) -> FloatArray:
    """Commanded state (..., S) after actions (..., A): state + scale * action, kept inside the box. Of a pose, the
    rotation is turned by that of the action, the gripper takes the action's value, and the rest stays.

    A state that starts outside the box (a reset pose may) is not pulled in by a zero action.
    """
    scale = np.asarray(spec.action_scale, np.float32)
    moved = _moved_pose(np, states, scale * actions) if moves_pose(spec) else states + scale * actions
    if spec.state_low:
        low = np.minimum(np.asarray(spec.state_low, np.float32), states)
        high = np.maximum(np.asarray(spec.state_high, np.float32), states)
        moved = np.clip(moved, low, high)
    return moved.astype(np.float32)


def next_commanded(states: FloatArray, actions: FloatArray, spec: EnvironmentSpec) -> FloatArray:
    """next_state of the commanded values; the measured ones stay as they are, for a model to say how they change."""
    kept = commanded_columns(spec)
    if kept and not spec.measured:
        return next_state(states, actions, spec)
    moved = states.astype(np.float32)
    if kept:
        moved[..., kept] = next_state(states[..., kept], actions, of_columns(spec, kept))
    return moved


def commanded_columns(spec: EnvironmentSpec) -> list[int]:
    """Which values of a state are not measured."""
    return [i for i in range(spec.state_dim) if i not in spec.measured]


def next_state_tensor(
    states_NS: Tensor, actions_NA: Tensor, scale_A: Tensor, box_2S: Tensor | None, *, pose: bool = False
) -> Tensor:
    """next_state, to the bit, of tensors on one device. scale_A: the spec's action_scale. box_2S: state_low and
    state_high; None: no box. pose: moves_pose(spec)."""
    moved = _moved_pose(torch, states_NS, scale_A * actions_NA) if pose else states_NS + scale_A * actions_NA
    if box_2S is None:
        return moved
    return torch.minimum(
        torch.maximum(moved, torch.minimum(box_2S[0], states_NS)), torch.maximum(box_2S[1], states_NS)
    )


def _moved_pose(xp: Any, states: Any, changes: Any) -> Any:
    """States (..., S) after changes (..., 7) in their units, float32; what follows the pose stays. xp: numpy or
    torch."""
    turned = multiply(xp, to_quaternion(xp, changes[..., 3:6]), to_quaternion(xp, states[..., 3:6]))
    rotation = xp.asarray(to_vector(xp, turned), dtype=xp.float32)
    return xp.concatenate([states[..., :3] + changes[..., :3], rotation, changes[..., 6:], states[..., 7:]], -1)


def hold_actions(states: FloatArray, spec: EnvironmentSpec) -> FloatArray:
    """Actions (N, A) that leave the commanded states (N, S) as they are."""
    held = np.zeros((len(states), spec.action_dim), np.float32)
    if moves_pose(spec):
        held[:, 6:] = np.clip(states[:, 6:7], -1, 1)
    return held


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
