"""A task of your own in a scene that is there; see config/tasks.py:Task, and for a scene of your own
environments/maniskill/tasks.

WM_TASKS=examples.own_task python -m wm_nodes.apps.cli collect /tmp/own_task --tasks own_task --episodes 2
"""
from dataclasses import replace

import numpy as np

from wm_nodes.config.tasks import ModelPart
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill import table_top
from wm_nodes.environments.maniskill.tasks import push_cube

NUDGE_M = 0.05


def nudged(truth: FloatArray) -> BoolArray:
    """truth: (..., P), of table_top.GROUND_TRUTH_NAMES."""
    way = truth[..., table_top.CUBE][..., :2] - truth[..., table_top.CUBE_START]
    return np.asarray(np.linalg.norm(way, axis=-1) > NUDGE_M)


TASK = replace(
    push_cube.TASK,
    instruction="nudge the blue cube away",
    success=nudged,
    settings={"data.behaviours": {"expert": 1.0}},
    model=ModelPart(positions=table_top.POSITIONS),
)
