"""What a task is, and where the files of the tasks are found.

A task is one file, <name>.py, with TASK = Task(...), in a folder `tasks` of a simulator's package or one that VARIABLE
names, itself or by its package. A robot's task is its instruction; what a simulator, a world model and the judge ask of
it are parts. Files are imported when a task is asked for, so that every layer may ask. Standard library only: launch
files list the tasks too. Shapes: P ground truth, A action, S state.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from wm_nodes.config.extensions import find_files, load_file
from wm_nodes.config.scenes import Scene, draw, scenes_of
from wm_nodes.config.seed_ranges import WEAK_DEMONSTRATIONS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float32]

FOLDER = "tasks"
VARIABLE = "WM_TASKS"
"""Environment variable with the names of further packages of task files, or full paths of such files, separated by
commas."""


@dataclass(frozen=True)
class WeakPolicy:
    """A policy cloned from a few demonstrations, whose noisy episodes a world model learns from too."""

    number: int
    """Decides the seeds; no two tasks of one world model have the same."""
    demonstrations: int
    """That it is cloned from."""
    noise: float
    """Standard deviation of the exploration noise, normalised action units."""

    @property
    def plan(self) -> tuple[int, int]:
        """How many demonstrations to try, and the first one's reset seed."""
        count = self.demonstrations + 3
        return count, WEAK_DEMONSTRATIONS.take(count, self.number)

    def __post_init__(self) -> None:
        """Raise ValueError for more policies or demonstrations than there are reset seeds for."""
        WEAK_DEMONSTRATIONS.take(self.demonstrations + 3, self.number)


@dataclass(frozen=True)
class Goal:
    """What has to get where, for the reward `outcome` of loop 2."""

    mover: Literal["object", "tool"]
    """What has to reach the goal."""
    radius_m: float
    """How near it has to be."""
    above_thing_m: float | None = None
    """The goal is this far above the object; None: it is the goal of the ground truth."""


@dataclass(frozen=True)
class SimulatorPart:
    """How a task is built, measured and acted in a simulator."""

    scene: Callable[[], Any]
    """Returns the simulator's environment class, to which scenes.py adds cameras and a plain table top; imports the
    simulator only when it is called. Tasks with the same function share one scene."""
    measure: Callable[[Any, Floats | None], Floats]
    """(simulator's environment, ground truth right after the reset or None at the reset) -> ground truth (P,)."""
    waypoints: Callable[[Floats], list[Floats]]
    """Ground truth (P,) -> world tool positions (3,) of a demonstration, which MPLib plans a path through; where
    actions are poses, states (7,) with the position in the world frame."""
    script: Callable[[str, Floats, np.random.Generator, float], Callable[[Floats, Floats], Floats]]
    """(behaviour, ground truth (P,) at the reset, random stream, metres of a full-scale action) -> act(ground truth
    (P,), state (S,)) -> action (A,) of one scripted episode. Raises ValueError for an unknown behaviour."""
    actions: Literal["translation", "pose"] = "translation"
    """What an action is, see core/action_spaces.py: translation, A = S = 3, or pose, 7 with rotation and gripper."""
    object_state: tuple[str, ...] = ()
    """Ground-truth names of lengths along x, y or z that a state may hold, see simulation.object_state."""
    hidden_state: tuple[str, ...] = ()
    """Those of them that the task's pictures do not show: 0 in states."""
    instruct: Callable[[Scene], str] | None = None
    """The instruction in one scene; None: the task has a scene of its own, and simulation.scenes is empty."""


@dataclass(frozen=True)
class ModelPart:
    """What a world model learns from a task's episodes, and what its acceptance asks."""

    tasks: tuple[str, ...] = ()
    """The tasks that one world model serves, this one among them: one done output each, in this order. Those with the
    same scene share the episodes of the last of them. Empty: this task alone."""
    positions: Mapping[str, str] = field(default_factory=dict)
    """Ground-truth name by the name of a position in m that the pictures show, of object_x, object_y, tool_x, tool_y,
    tool_z, goal_x and goal_y: what probes learn. Empty: they learn all ground truth, and nothing is asked of it."""
    moves_object: bool = True
    """False: the error of the object is not part of acceptance, only the tool's."""
    demonstrator: str = "expert"
    """The scripted behaviour whose successes teach the text model."""
    weak_policies: tuple[WeakPolicy, ...] = ()
    """Used where data.policy_episodes is not 0."""


@dataclass(frozen=True)
class JudgePart:
    """What clips of a task are measured by."""

    goal: Goal | None = None
    """None: loop 2's reward `outcome` has no number for this task."""
    object_height_m: float = 0.0
    """Of the object's middle above the table, where it lies."""


@dataclass(frozen=True)
class Task:
    """What is known of one task. Its name is that of its file; an instruction is enough for a robot's."""

    instruction: str
    """What the text model and the judge read. Of a task in many scenes, it says `object` and `container`."""
    ground_truth_names: tuple[str, ...] = ()
    """Simulator truth in this order: positions in m, angles in rad, world frame."""
    success: Callable[[Floats], NDArray[np.bool_]] | None = None
    """Ground truth (..., P) -> (...,); False where it is NaN. None: success is the flag that was recorded."""
    parts: tuple[str, ...] = ()
    """Of a task whose every episode is one of another task: those, see part_of. Its states end with a value for each of
    them, 1 for the episode's and 0 for the others, and its ground truth with the number of the episode's."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Dotted settings of loop 1 laid over base.yaml, below the preset and the command line."""
    simulator: SimulatorPart | None = None
    """None: the simulator cannot show it."""
    model: ModelPart = field(default_factory=ModelPart)
    """The world model's part."""
    judge: JudgePart = field(default_factory=JudgePart)
    """The part of what judges clips."""


def task_names() -> tuple[str, ...]:
    """Every known task, sorted."""
    return tuple(sorted(_files()))


def check_task(name: str) -> str:
    """Return the name of a known task. Raises ValueError that names the known ones."""
    if name not in (known := task_names()):
        raise ValueError(f"unknown task {name!r}; choose one of {', '.join(known)}")
    return name


@functools.cache
def get_task(name: str) -> Task:
    """Import the task's file.

    Raises:
        ValueError: no such task, or its file defines none; names what is known.
    """
    return load_file(check_task(name), _files(), Task, __name__)


def model_tasks(name: str) -> tuple[str, ...]:
    """The tasks of the world model that serves this one, with a file or without."""
    return (get_task(name).model.tasks if name in task_names() else ()) or (name,)


def parts_of(name: str) -> tuple[str, ...]:
    """The tasks that an episode of this one may be of: those of Task.parts, or this one, with a file or without."""
    return (get_task(name).parts if name in task_names() else ()) or (name,)


def part_of(name: str, seed: int) -> str:
    """The task, of parts_of, that the episode is of which is reset with `seed`."""
    parts = parts_of(name)
    return parts[draw(f"task {seed % 2**32}", len(parts))]


def recorded_task(name: str) -> str:
    """The task that the episodes for this one's world model are recorded for: the last of its scene."""
    if get_task(name).parts:
        return name
    return [task for task in model_tasks(name) if shares_scene(name, task)][-1]


def shares_scene(task: str, other: str) -> bool:
    """Whether an episode that was recorded for one task shows whether the other is done. So it does where it is not
    known what it was recorded for; what has no file is shown by its own episodes alone."""
    if task == other or not has_rule(other):
        return task == other
    if task not in task_names() or same_scene(task, other):
        return True
    return task in get_task(other).parts


def same_scene(task: str, other: str) -> bool:
    """Whether a simulator shows both tasks in one scene."""
    scenes = [simulator.scene for name in (task, other) if (simulator := get_task(name).simulator)]
    return len(scenes) == 2 and scenes[0] is scenes[1]


def simulator_part(name: str) -> SimulatorPart:
    """Of a task that the simulator can show. Raises ValueError for another one."""
    part = get_task(name).simulator
    if part is None:
        raise ValueError(f"task {name!r} has no `simulator` in its file, so that nothing simulates it; take the spec "
                         "of its robot, its recordings or its model")
    return part


def has_simulator(name: str) -> bool:
    """Whether the simulator can show a task. False for no name."""
    return bool(name) and get_task(name).simulator is not None


def truth_columns(name: str, thing: str) -> list[int]:
    """Which ground-truth values of a task are the position of the object, the tool or the goal; [] where none is."""
    names, positions = get_task(name).ground_truth_names, get_task(name).model.positions
    return [names.index(truth) for position, truth in positions.items() if position.startswith(f"{thing}_")]


def has_rule(name: str) -> bool:
    """Whether ground truth says that the task is done; otherwise success is the flag that was recorded."""
    return name in task_names() and get_task(name).success is not None


def success(task: str, ground_truth: Floats) -> NDArray[np.bool_]:
    """Whether `task` is done in each (..., P) ground truth; False where it is NaN. Raises ValueError without a rule."""
    rule = get_task(task).success
    if rule is None:
        raise ValueError(f"task {task!r} has no success rule in its file; take the flag that was recorded")
    return rule(ground_truth)


def success_or_recorded(task: str, ground_truth: Floats, recorded: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether `task` is done in each (..., P) ground truth by its rule, or without a rule or ground truth as recorded.

    recorded: (...,), the flags.
    """
    return success(task, ground_truth) if has_rule(task) and ground_truth.shape[-1] else recorded


def instruction(task: str, scenes: str, setting: str = "simulation.scenes") -> str:
    """The instruction of a batch of episodes: of the scene where `scenes`, a value of the setting, is one, else the
    task's.

    Raises:
        ValueError: the task has a scene of its own and `scenes` is not empty, or the other way round.
    """
    chosen, known = get_task(task), scenes_of(scenes)
    instruct = chosen.simulator.instruct if chosen.simulator else None
    if bool(known) != (instruct is not None):
        needs = f"needs {setting}, e.g. train" if instruct else "has a scene of its own; leave it empty"
        raise ValueError(f"{setting} is {scenes!r}, but task {task!r} {needs}")
    return instruct(known[0]) if instruct and len(known) == 1 else chosen.instruction


def _files() -> dict[str, str]:
    """Package by task. Raises ValueError as find_files."""
    return find_files("task", FOLDER, VARIABLE)
