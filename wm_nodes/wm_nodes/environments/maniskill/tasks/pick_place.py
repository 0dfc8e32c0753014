"""Pick up the object and release it in the container, in the procedural scenes."""

from typing import Any

import numpy as np

from wm_nodes.config.scenes import Scene
from wm_nodes.config.tasks import JudgePart, ModelPart, SimulatorPart, Task
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill import objects
from wm_nodes.environments.maniskill.layouts import ANYWHERE, CONTAINERS, Layout, draw, free_of
from wm_nodes.environments.maniskill.pose_behaviours import CARRYING, scripted
from wm_nodes.environments.maniskill.pose_scripts import place_waypoints

RIM_M = 0.015
"""The object's centre lies at least this far inside the container's rim,"""
ABOVE_RIM_M = 0.02
"""and its lowest point at most this far above it."""
STILL_M_S = 0.02


def place(rng: np.random.Generator) -> Layout:
    start, container = draw(rng, (ANYWHERE, CONTAINERS), lambda start, container: free_of(container, start, start))
    return Layout(start, rng.uniform(-np.pi / 4, np.pi / 4), container, container)


def scene() -> Any:
    from wm_nodes.environments.maniskill.object_scene import ObjectScene

    return type("PickPlaceScene", (ObjectScene,), {"place": staticmethod(place)})


def success(truth: FloatArray) -> BoolArray:
    """The object lies in the container, still and released."""
    inside = objects.goal_distance(truth) < truth[..., objects.RADIUS] - RIM_M
    bottom = truth[..., objects.BOTTOM]
    height = (bottom > 0) & (bottom < truth[..., objects.HEIGHT] + ABOVE_RIM_M)
    released = (truth[..., objects.GRASPED] == 0) & (truth[..., objects.SPEED] < STILL_M_S)
    return np.asarray(inside & height & released)


def instruct(scene: Scene) -> str:
    return f"pick up the {scene.object} and place it in the {scene.container}"


TASK = Task(
    instruction="pick up the object and place it in the container",
    ground_truth_names=objects.GROUND_TRUTH_NAMES,
    success=success,
    settings={**objects.SETTINGS, **objects.GRASPING, **objects.policy_sees("container"), "data.behaviours": CARRYING},
    simulator=SimulatorPart(
        scene, objects.measure, place_waypoints, scripted(place_waypoints, speed=0.8), actions="pose",
        object_state=objects.STATE, hidden_state=objects.NO_CARPET, instruct=instruct,
    ),
    model=ModelPart(
        tasks=objects.MODEL_TASKS, positions=objects.WITH_GOAL, weak_policies=objects.weak_policies(1)
    ),
    judge=JudgePart(object_height_m=objects.MIDDLE_M),
)
