"""Pull the cube into the goal disc, towards the robot."""

from dataclasses import replace
from typing import Any

from wm_nodes.config.tasks import ModelPart, WeakPolicy
from wm_nodes.environments.maniskill import table_top
from wm_nodes.environments.maniskill.tasks import push_cube


def scene() -> Any:
    from mani_skill.envs.tasks.tabletop.pull_cube import PullCubeEnv

    return PullCubeEnv


TASK = replace(
    push_cube.TASK, instruction="pull the blue cube into the red target", settings={},
    simulator=replace(push_cube.SIMULATOR, scene=scene),
    model=ModelPart(positions=table_top.POSITIONS, weak_policies=(WeakPolicy(4, 4, 0.3),)),
)
