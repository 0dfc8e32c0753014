"""What a shape is. Lengths in m."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
from transforms3d.euler import euler2quat
from transforms3d.quaternions import quat2mat

from wm_nodes.config.extensions import load_file
from wm_nodes.config.scenes import shapes
from wm_nodes.core.types import FloatArray

UPRIGHT = sapien.Pose(q=euler2quat(0, np.pi / 2, 0))
"""SAPIEN's cylinders and capsules lie along x."""


@dataclass(frozen=True)
class Shape:
    """An object without its colour."""

    build: Callable[[Any, Any], None]
    """(SAPIEN actor builder, render material): add the collision and the visual shapes around the object's centre."""
    rest_height_m: float
    """Of the centre above the table, where an episode begins."""
    lowest_m: Callable[[FloatArray], float]
    """The world's upward direction in the object's frame, unit vector (3,) -> how far its lowest point is below its
    centre."""


@functools.cache
def get_shape(name: str) -> Shape:
    """Import the shape's file.

    Raises:
        ValueError: no such shape, or its file defines none.
    """
    if name not in (known := shapes()):
        raise ValueError(f"unknown shape {name!r}; choose one of {', '.join(known)}")
    return load_file(name, known, Shape, __name__)


def bottom_m(name: str, height: float, quaternion: Sequence[float]) -> float:
    """The lowest point of an object whose centre is `height` above the table."""
    return float(height - get_shape(name).lowest_m(quat2mat(quaternion)[2]))
