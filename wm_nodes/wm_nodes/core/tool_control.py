"""The controller's rule, equal in every environment (RS-9): legal actions, and where they command the tool."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from wm_nodes.core.action_spaces import POSE
from wm_nodes.core.rotations import multiply, to_quaternion, to_vector
from wm_nodes.core.specs import EnvironmentSpec
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
    box = np.asarray((spec.state_low, spec.state_high), np.float32) if spec.state_low else None
    moved: FloatArray = _moved(np, states, scale * actions, box, pose=moves_pose(spec)).astype(np.float32)
    return moved


class CommandedMove:
    """next_state, to the bit, of tensors on one device; the measured values stay as they are, for a model to say how
    they change."""

    def __init__(self, spec: EnvironmentSpec, device: torch.device) -> None:
        commanded = [i for i in range(spec.state_dim) if i not in spec.measured]
        self._columns = torch.tensor(commanded, dtype=torch.int64).to(device)
        self._scale = torch.tensor(spec.action_scale, dtype=torch.float32).to(device)
        box = torch.tensor((spec.state_low, spec.state_high), dtype=torch.float32)
        self._box = box[:, commanded].to(device) if spec.state_low else None
        self._pose, self._whole = moves_pose(spec), bool(commanded) and not spec.measured

    def __call__(self, states_NS: Tensor, actions_NA: Tensor) -> Tensor:
        """States (N, S) after actions (N, A)."""
        if not len(self._columns):
            return states_NS
        given = states_NS if self._whole else states_NS[:, self._columns]
        moved: Tensor = _moved(torch, given, self._scale * actions_NA, self._box, pose=self._pose)
        return moved if self._whole else states_NS.index_copy(1, self._columns, moved)


def _moved(xp: Any, states: Any, changes: Any, box: Any, *, pose: bool) -> Any:
    """States (..., S) after changes (..., A) in their units. box: (2, S), least and largest; None: no limits. xp: numpy
    or torch."""
    moved = _moved_pose(xp, states, changes) if pose else states + changes
    if box is None:
        return moved
    return xp.minimum(xp.maximum(moved, xp.minimum(box[0], states)), xp.maximum(box[1], states))


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
