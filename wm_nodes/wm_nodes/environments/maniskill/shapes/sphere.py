"""A ball. Lengths in m."""

from typing import Any

from wm_nodes.environments.maniskill.shape import Shape

RADIUS_M = 0.024


def build(builder: Any, material: Any) -> None:
    builder.add_sphere_collision(radius=RADIUS_M)
    builder.add_sphere_visual(radius=RADIUS_M, material=material)


SHAPE = Shape(build, rest_height_m=RADIUS_M, lowest_m=lambda up: RADIUS_M)
