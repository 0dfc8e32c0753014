"""Which positions the probes of a world model read off its frames: those that the files of its tasks name."""

import numpy as np

from wm_nodes.config.tasks import get_task, model_tasks, task_names
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray


def position_names(task: str) -> tuple[str, ...]:
    """Names of the positions that the tasks of this one's world model have; () where their files name none."""
    known = [get_task(name).model.positions for name in model_tasks(task) if name in task_names()]
    return tuple(dict.fromkeys(name for positions in known for name in positions))


def columns_of(task: str, thing: str) -> list[int]:
    """Which of the positions (P,) are those of the object, the tool or the goal; [] where none is."""
    return [i for i, name in enumerate(position_names(task)) if name.startswith(f"{thing}_")]


def num_positions_of(spec: EnvironmentSpec, *, success_state: bool = False) -> int:
    """P, how many values the models of an environment read off frames: without ground truth none, or the state
    and the one at success (tokenizer.success_state)."""
    if not spec.ground_truth_names:
        return 2 * spec.tool_dim if success_state else 0
    return len(position_names(spec.task)) or spec.ground_truth_dim


def probe_targets(ground_truth: FloatArray, task: str) -> FloatArray:
    """What probes learn (..., P) out of a task's ground truth: its positions, NaN where its pictures do not show one;
    all of it where no position is named."""
    names = position_names(task)
    if not names:
        return ground_truth
    positions, known = get_task(task).model.positions, get_task(task).ground_truth_names
    unknown = np.full(ground_truth.shape[:-1], np.nan, np.float32)
    columns = [ground_truth[..., known.index(positions[name])] if name in positions else unknown for name in names]
    return np.stack(columns, -1)


def judged_things(task: str) -> tuple[str, ...]:
    """Of tool and object, those whose place a world model of the task is judged by."""
    things = ("tool", "object") if task in task_names() and get_task(task).model.moves_object else ("tool",)
    return tuple(thing for thing in things if columns_of(task, thing))
