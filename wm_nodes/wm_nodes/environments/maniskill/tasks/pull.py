"""Pull the object 10 cm towards the robot, in the procedural scenes."""

from dataclasses import replace
from typing import Any

import numpy as np

from wm_nodes.config.scenes import Scene
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill import objects
from wm_nodes.environments.maniskill.layouts import Layout
from wm_nodes.environments.maniskill.tasks import push


def place(rng: np.random.Generator) -> Layout:
    return push.place_on_way(rng, -1, ((-0.04, -0.12), (0.06, 0.12)))


def scene() -> Any:
    from wm_nodes.environments.maniskill.object_scene import ObjectScene

    return type("PullScene", (ObjectScene,), {"place": staticmethod(place)})


def success(truth: FloatArray) -> BoolArray:
    return objects.pushed(truth, -1, push.DISTANCE_M, push.ASIDE_M)


def instruct(scene: Scene) -> str:
    return f"pull the {scene.object} towards the robot"


TASK = replace(
    push.TASK, instruction="pull the object towards the robot", success=success,
    simulator=replace(push.SIMULATOR, scene=scene, instruct=instruct),
    model=replace(push.TASK.model, weak_policies=objects.weak_policies(4)),
)
