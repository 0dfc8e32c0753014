"""What a spec is to Gymnasium. Shapes: S state, A action, H W 3 image."""

import numpy as np
from gymnasium import spaces

from wm_nodes.core.specs import EnvironmentSpec

MARGIN = np.float32(1)
"""A start may lie outside of the box that actions keep the state in."""


def observation_space(spec: EnvironmentSpec) -> spaces.Dict:
    """The space of image uint8 (H, W, 3), cameras side by side, and of state float32 (S,) where there is one; without a
    box in the spec it is unbounded."""
    boxes = {"image": spaces.Box(0, 255, (spec.height, spec.width, 3), np.uint8)}
    if spec.state_dim:
        far = (np.inf,) * spec.state_dim
        low, high = np.array(spec.state_low or far, np.float32), np.array(spec.state_high or far, np.float32)
        boxes["state"] = spaces.Box(low - MARGIN if spec.state_low else -low, high + MARGIN)
    return spaces.Dict(boxes)


def action_space(spec: EnvironmentSpec) -> spaces.Box:
    """(A,) in [-1, 1]."""
    return spaces.Box(-1, 1, (spec.action_dim,), np.float32)
