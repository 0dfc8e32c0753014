"""The parts of the procedural scenes: an object of a shape, two containers, a carpet. Primitives only. Lengths in m.

Every part stands on the table, z = 0, at x y.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
from transforms3d.euler import euler2quat

from wm_nodes.config.scenes import Scene
from wm_nodes.environments.maniskill.layouts import Point
from wm_nodes.environments.maniskill.shape import UPRIGHT, get_shape

COLOURS = {
    "red": (0.72, 0.05, 0.05), "green": (0.05, 0.45, 0.10), "blue": (0.04, 0.12, 0.62), "yellow": (0.85, 0.66, 0.03),
    "plate": (0.90, 0.90, 0.88), "bowl": (0.06, 0.38, 0.42), "carpet": (0.50, 0.08, 0.42),
    "grey_table": (0.42, 0.43, 0.45), "brown_table": (0.36, 0.22, 0.13),
}
CONTAINER_RADIUS_M = 0.06
CONTAINER_HEIGHT_M = {"plate": 0.008, "bowl": 0.028}
BOWL_FLOOR_M, BOWL_WALL_M, NUM_WALLS = 0.004, 0.004, 12
CARPET_HALF_M = 0.05
ANGULAR_DAMPING = 8.0
"""Of every object, 1/s: PhysX has no rolling friction, and a ball that was touched would roll off the table."""


def build_object(scene: Any, which: Scene, place: Point, yaw: float) -> Any:
    """The dynamic actor of a scene's object, turned by `yaw`, rad."""
    builder, shape = scene.create_actor_builder(), get_shape(which.shape)
    shape.build(builder, _material(which.colour))
    builder.initial_pose = sapien.Pose([*place, shape.rest_height_m], euler2quat(0, 0, yaw))
    actor = builder.build(which.object)
    actor._bodies[0].angular_damping = ANGULAR_DAMPING
    return actor


def build_container(scene: Any, kind: str, place: Point) -> Any:
    """A plate, or a bowl with an upright wall, that stays where it is."""
    builder, material = scene.create_actor_builder(), _material(kind)
    height = CONTAINER_HEIGHT_M["plate"] if kind == "plate" else BOWL_FLOOR_M
    floor = sapien.Pose([0, 0, height / 2], UPRIGHT.q)
    builder.add_cylinder_collision(floor, CONTAINER_RADIUS_M, height / 2)
    builder.add_cylinder_visual(floor, CONTAINER_RADIUS_M, height / 2, material)
    for half, pose in _walls() if kind == "bowl" else ():
        builder.add_box_collision(pose, half)
        builder.add_box_visual(pose, half, material)
    builder.initial_pose = sapien.Pose([*place, 0])
    return builder.build_kinematic(kind)


def build_carpet(scene: Any, place: Point) -> Any:
    """A thin square that is only seen."""
    builder = scene.create_actor_builder()
    builder.add_box_visual(sapien.Pose([0, 0, 0.001]), [CARPET_HALF_M, CARPET_HALF_M, 0.0005], _material("carpet"))
    builder.initial_pose = sapien.Pose([*place, 0])
    return builder.build_kinematic("carpet")


def _walls() -> list[tuple[Sequence[float], sapien.Pose]]:
    """Half sizes and poses of the boxes around a bowl."""
    height = CONTAINER_HEIGHT_M["bowl"] / 2
    away = CONTAINER_RADIUS_M - BOWL_WALL_M / 2
    half = [BOWL_WALL_M / 2, CONTAINER_RADIUS_M * np.tan(np.pi / NUM_WALLS), height]
    angles = 2 * np.pi / NUM_WALLS * np.arange(NUM_WALLS)
    return [
        (half, sapien.Pose([away * np.cos(angle), away * np.sin(angle), height], euler2quat(0, 0, angle)))
        for angle in angles
    ]


def _material(colour: str) -> sapien.render.RenderMaterial:
    return sapien.render.RenderMaterial(base_color=[*COLOURS[colour], 1.0], roughness=0.8, specular=0.2)
