"""A bar that lies on its long side. Lengths in m."""

from typing import Any

import numpy as np

from wm_nodes.environments.maniskill.shape import Shape

HALF_M = [0.038, 0.015, 0.015]


def build(builder: Any, material: Any) -> None:
    builder.add_box_collision(half_size=HALF_M)
    builder.add_box_visual(half_size=HALF_M, material=material)


SHAPE = Shape(build, rest_height_m=HALF_M[2], lowest_m=lambda up: float(np.abs(up) @ HALF_M))
