"""A cube. Lengths in m."""

from typing import Any

import numpy as np

from wm_nodes.environments.maniskill.shape import Shape

HALF_M = 0.022


def build(builder: Any, material: Any) -> None:
    builder.add_box_collision(half_size=[HALF_M] * 3)
    builder.add_box_visual(half_size=[HALF_M] * 3, material=material)


SHAPE = Shape(build, rest_height_m=HALF_M, lowest_m=lambda up: float(HALF_M * np.abs(up).sum()))
