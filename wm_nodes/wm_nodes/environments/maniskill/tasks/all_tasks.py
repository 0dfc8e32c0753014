"""All tasks of the procedural scenes, for one policy: each episode is of one of them, and the state says of which."""

from typing import Any

import numpy as np

from wm_nodes.config.scenes import Scene
from wm_nodes.config.tasks import JudgePart, ModelPart, SimulatorPart, Task, part_of, simulator_part
from wm_nodes.config.tasks import success as done
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill import objects
from wm_nodes.environments.maniskill.pose_behaviours import MOVING

PARTS = objects.MODEL_TASKS


def scene() -> Any:
    from wm_nodes.environments.maniskill.object_scene import ObjectScene

    scenes = {part: simulator_part(part).scene() for part in PARTS}

    class AllTasksScene(ObjectScene):
        """Each episode's scene is that of its task."""

        def _load_scene(self, options: dict[str, Any]) -> None:
            self.part = part_of("all_tasks", int(self._episode_seed[0]))
            self.place = scenes[self.part].place
            super()._load_scene(options)

    return AllTasksScene


def measure(scene: Any, start: FloatArray | None) -> FloatArray:
    return np.append(objects.measure(scene, start), np.float32(PARTS.index(scene.part)))


def success(truth: FloatArray) -> BoolArray:
    cases = [(truth[..., -1] == number) & done(part, truth) for number, part in enumerate(PARTS)]
    return np.asarray(np.logical_or.reduce(cases))


def waypoints(truth: FloatArray) -> list[FloatArray]:
    return simulator_part(PARTS[int(truth[-1])]).waypoints(truth)


def script(behaviour: str, truth: FloatArray, rng: np.random.Generator, full_m: float) -> Any:
    return simulator_part(PARTS[int(truth[-1])]).script(behaviour, truth, rng, full_m)


def instruct(scene: Scene) -> str:
    """Where it is not known which task it is."""
    return f"do the task with the {scene.object}"


TASK = Task(
    instruction="do the task with the object",
    ground_truth_names=(*objects.GROUND_TRUTH_NAMES, "task"),
    success=success,
    parts=PARTS,
    settings={
        **objects.SETTINGS, **objects.GRASPING, "data.behaviours": MOVING, "sft.num_demonstrations": 1500,
        "sft.num_iterations": 3000,
    },
    simulator=SimulatorPart(
        scene, measure, waypoints, script, actions="pose", object_state=objects.STATE, instruct=instruct
    ),
    model=ModelPart(tasks=PARTS, positions=objects.POSITIONS),
    judge=JudgePart(object_height_m=objects.MIDDLE_M),
)
