"""Move the gripper above the object, in the procedural scenes."""

from typing import Any

import numpy as np

from wm_nodes.config.scenes import Scene
from wm_nodes.config.tasks import JudgePart, ModelPart, SimulatorPart, Task
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill import objects
from wm_nodes.environments.maniskill.layouts import ANYWHERE, CONTAINERS, Layout, Point, draw, free_of
from wm_nodes.environments.maniskill.pose_behaviours import MOVING, scripted
from wm_nodes.environments.maniskill.pose_scripts import CLOSED, waypoint
from wm_nodes.environments.maniskill.table_top import TOOL, above_cube

TOLERANCE_M = 0.02
LEAST_WAY_M = 0.05


def place(rng: np.random.Generator) -> Layout:
    start, container = draw(rng, (ANYWHERE, CONTAINERS), apart)
    return Layout(start, rng.uniform(-np.pi / 4, np.pi / 4), container, start)


def apart(start: Point, container: Point) -> bool:
    """The tool starts near x = y = 0, at 15 to 19 cm, and is not to be there yet."""
    return bool(np.linalg.norm(start) > LEAST_WAY_M) and free_of(container, start, start)


def scene() -> Any:
    from wm_nodes.environments.maniskill.object_scene import ObjectScene

    return type("ReachObjectScene", (ObjectScene,), {"place": staticmethod(place)})


def success(truth: FloatArray) -> BoolArray:
    return np.asarray(np.linalg.norm(truth[..., TOOL] - above_cube(truth), axis=-1) < TOLERANCE_M)


def waypoints(truth: FloatArray) -> list[FloatArray]:
    target = above_cube(truth)
    return [waypoint(target[:2], target[2], 0.0, CLOSED)]


def instruct(scene: Scene) -> str:
    return f"move the gripper above the {scene.object}"


TASK = Task(
    instruction="move the gripper above the object",
    ground_truth_names=objects.GROUND_TRUTH_NAMES,
    success=success,
    settings={**objects.SETTINGS, **objects.policy_sees(), "data.behaviours": MOVING},
    simulator=SimulatorPart(
        scene, objects.measure, waypoints, scripted(waypoints, speed=0.8), actions="pose", instruct=instruct,
        object_state=objects.STATE, hidden_state=objects.NO_CARPET,
    ),
    model=ModelPart(
        tasks=objects.MODEL_TASKS, positions=objects.POSITIONS, moves_object=False,
        weak_policies=objects.weak_policies(3),
    ),
    judge=JudgePart(object_height_m=objects.MIDDLE_M),
)
