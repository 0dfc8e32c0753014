"""Move the object onto the carpet, in the procedural scenes; it need not be released."""

from typing import Any

import numpy as np

from wm_nodes.config.scenes import Scene
from wm_nodes.config.tasks import JudgePart, ModelPart, SimulatorPart, Task
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill import objects
from wm_nodes.environments.maniskill.layouts import ANYWHERE, CONTAINERS, Layout, Point, draw, free_of
from wm_nodes.environments.maniskill.pose_behaviours import CARRYING, scripted
from wm_nodes.environments.maniskill.pose_scripts import carry_waypoints

RADIUS_M, HEIGHT_M = 0.05, 0.02
LEAST_WAY_M = 0.11
"""From the object to the carpet's centre at the start: the two do not touch."""


def place(rng: np.random.Generator) -> Layout:
    def apart(start: Point, goal: Point, container: Point) -> bool:
        return bool(np.linalg.norm(goal - start) > LEAST_WAY_M) and free_of(container, start, goal)

    start, goal, container = draw(rng, (ANYWHERE, ANYWHERE, CONTAINERS), apart)
    return Layout(start, rng.uniform(-np.pi / 4, np.pi / 4), container, goal, carpet=True)


def scene() -> Any:
    from wm_nodes.environments.maniskill.object_scene import ObjectScene

    return type("MoveToAimScene", (ObjectScene,), {"place": staticmethod(place)})


def success(truth: FloatArray) -> BoolArray:
    """The object's centre is near the carpet's, and as good as on it."""
    return np.asarray((objects.goal_distance(truth) < RADIUS_M) & (truth[..., objects.BOTTOM] < HEIGHT_M))


def instruct(scene: Scene) -> str:
    return f"move the {scene.object} onto the carpet"


TASK = Task(
    instruction="move the object onto the carpet",
    ground_truth_names=objects.GROUND_TRUTH_NAMES,
    success=success,
    settings={**objects.SETTINGS, **objects.GRASPING, **objects.policy_sees("goal"), "data.behaviours": CARRYING},
    simulator=SimulatorPart(
        scene, objects.measure, carry_waypoints, scripted(carry_waypoints, speed=0.8), actions="pose",
        object_state=objects.STATE, instruct=instruct,
    ),
    model=ModelPart(
        tasks=objects.MODEL_TASKS, positions=objects.WITH_GOAL, weak_policies=objects.weak_policies(0)
    ),
    judge=JudgePart(object_height_m=objects.MIDDLE_M),
)
