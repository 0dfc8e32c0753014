"""Push the object 10 cm away from the robot, in the procedural scenes."""

from typing import Any

import numpy as np

from wm_nodes.config.scenes import Scene
from wm_nodes.config.tasks import JudgePart, ModelPart, SimulatorPart, Task
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill import objects
from wm_nodes.environments.maniskill.layouts import CONTAINERS, Layout, Point, Rectangle, draw, free_of
from wm_nodes.environments.maniskill.pose_behaviours import MOVING, scripted
from wm_nodes.environments.maniskill.pose_scripts import push_waypoints

DISTANCE_M, ASIDE_M = 0.10, 0.05
BEHIND_M = 0.09
"""From the object's centre to where the tool comes down."""
BEYOND_M = 0.04
"""The way is free this much further than it has to be."""


def place(rng: np.random.Generator) -> Layout:
    return place_on_way(rng, 1, ((-0.10, -0.12), (0.02, 0.12)))


def place_on_way(rng: np.random.Generator, direction: int, objects: Rectangle) -> Layout:
    """The object in a rectangle, its way along x (1: forwards, -1: backwards) free of the container."""
    way = np.array([direction, 0.0])

    def free(start: Point, container: Point) -> bool:
        return free_of(container, start - BEHIND_M * way, start + (DISTANCE_M + BEYOND_M) * way)

    start, container = draw(rng, (objects, CONTAINERS), free)
    return Layout(start, rng.uniform(-np.pi / 4, np.pi / 4), container, start + DISTANCE_M * way)


def scene() -> Any:
    from wm_nodes.environments.maniskill.object_scene import ObjectScene

    return type("PushScene", (ObjectScene,), {"place": staticmethod(place)})


def success(truth: FloatArray) -> BoolArray:
    return objects.pushed(truth, 1, DISTANCE_M, ASIDE_M)


def waypoints(truth: FloatArray) -> list[FloatArray]:
    return push_waypoints(truth, BEHIND_M)


def instruct(scene: Scene) -> str:
    return f"push the {scene.object} away from the robot"


SIMULATOR = SimulatorPart(
    scene, objects.measure, waypoints, scripted(waypoints, speed=0.5), actions="pose", instruct=instruct,
    object_state=objects.STATE, hidden_state=objects.NO_CARPET,
)
TASK = Task(
    instruction="push the object away from the robot",
    ground_truth_names=objects.GROUND_TRUTH_NAMES,
    success=success,
    settings={
        **objects.SETTINGS, **objects.policy_sees(), "data.behaviours": MOVING, "policy.init_log_std": -2.0,
        "ppo.target_kl": 0.2, "ppo.kl_reference_weight": 0.01,
    },
    simulator=SIMULATOR,
    model=ModelPart(
        tasks=objects.MODEL_TASKS, positions=objects.POSITIONS, weak_policies=objects.weak_policies(2)
    ),
    judge=JudgePart(object_height_m=objects.MIDDLE_M),
)
