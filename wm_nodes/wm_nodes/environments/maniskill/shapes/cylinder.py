"""A cylinder that stands. Lengths in m."""

from typing import Any

import numpy as np

from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.shape import UPRIGHT, Shape

RADIUS_M, HALF_M = 0.019, 0.028


def build(builder: Any, material: Any) -> None:
    builder.add_cylinder_collision(UPRIGHT, radius=RADIUS_M, half_length=HALF_M)
    builder.add_cylinder_visual(UPRIGHT, radius=RADIUS_M, half_length=HALF_M, material=material)


def lowest(up: FloatArray) -> float:
    return float(HALF_M * abs(up[2]) + RADIUS_M * np.sqrt(max(0.0, 1 - up[2] ** 2)))


SHAPE = Shape(build, rest_height_m=HALF_M, lowest_m=lowest)
