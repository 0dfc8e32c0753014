"""A capsule that lies. Lengths in m."""

from typing import Any

from wm_nodes.environments.maniskill.shape import Shape

RADIUS_M, HALF_M = 0.019, 0.02
"""The half length is that of the axis, without the caps."""


def build(builder: Any, material: Any) -> None:
    builder.add_capsule_collision(radius=RADIUS_M, half_length=HALF_M)
    builder.add_capsule_visual(radius=RADIUS_M, half_length=HALF_M, material=material)


SHAPE = Shape(build, rest_height_m=RADIUS_M, lowest_m=lambda up: float(HALF_M * abs(up[0]) + RADIUS_M))
