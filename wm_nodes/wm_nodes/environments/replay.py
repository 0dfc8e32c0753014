"""Executability: the tool's path in an imagined clip, followed in the simulator. Physics alone, no pictures.

Shapes: N clips, F frames, P ground truth. Positions in m, world frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wm_nodes.config.environments import SimulationConfig
from wm_nodes.config.tasks import success, truth_columns
from wm_nodes.core.tool_control import hold_actions
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment


@dataclass(frozen=True)
class Executed:
    """What came of each clip."""

    starts: FloatArray
    """(N, P), ground truth after the reset."""
    success: BoolArray
    """(N,), the task is done at the end."""
    object_error_cm: NDArray[np.float64]
    """(N,), from where the object ends to the imagined place, in the plane."""
    tool_error_cm: NDArray[np.float64]
    """(N,), mean distance of the tool from the path, at its frames."""


def execute_paths(
    task: str, simulation: SimulationConfig, seeds: Sequence[int], paths: FloatArray, objects: FloatArray, stride: int
) -> Executed:
    """Follow each tool path (N, F, 3) from the scene of its reset seed, `stride` control steps from frame to frame.

    Each step commands action = clip((target - tool) / max_action_m, -1, 1), target on the straight line between two
    frames; where actions are poses, rotation and gripper stay as they are. `tool` is the measured tool, not the
    commanded one, which the arm lags behind: so the tool gets to where the clip shows it. A step that is too long for
    the arm is not made up for; that is a part of the answer.

    Args:
        simulation: of the recordings that the clips begin with.
        objects: the imagined final places of the object, (N, 2).

    Raises:
        ValueError: arrays do not belong together, or a path is not finite.
    """
    expected = (len(seeds), *paths.shape[1:2], 3), (len(seeds), 2)
    if (paths.shape, objects.shape) != expected or not len(seeds):
        raise ValueError(f"{len(seeds)} seeds go with paths (N, F, 3) and objects (N, 2), got {paths.shape} and "
                         f"{objects.shape}; give one of each per clip")
    if not np.isfinite(paths).all():
        raise ValueError(f"path {int(np.flatnonzero(~np.isfinite(paths).all((1, 2)))[0])} is not finite; leave it out")
    return _compare(task, _follow(task, simulation, stride, seeds, paths), paths, objects)


def _follow(
    task: str, simulation: SimulationConfig, stride: int, seeds: Sequence[int], paths: FloatArray
) -> FloatArray:
    """Return the ground truth at the frames, (N, F, P)."""
    steps = stride * (paths.shape[1] - 1)
    enough = simulation.model_copy(update={"max_episode_steps": max(steps, 1) + 1})
    tool = truth_columns(task, "tool")
    env = ManiSkillEnvironment(task, enough, end_on_success=False, pictures=False)
    truths = np.empty((*paths.shape[:2], env.spec.ground_truth_dim), np.float32)
    for clip, path in enumerate(paths):
        env.reset(seeds=np.array([seeds[clip]], np.uint64))
        truths[clip, 0], actions = env.ground_truth[0], hold_actions(env.current().state, env.spec)
        for step in range(steps):
            frame, share = step // stride, (step % stride + 1) / stride
            target = path[frame] + share * (path[frame + 1] - path[frame])
            actions[:, :3] = np.clip((target - env.ground_truth[0, tool]) / env.spec.action_scale[0], -1, 1)
            truths[clip, frame + 1] = env.step(actions).ground_truth[0]
    env.close()
    return truths


def _compare(task: str, truths: FloatArray, paths: FloatArray, objects: FloatArray) -> Executed:
    ends, tool = truths[:, -1], truth_columns(task, "tool")
    missed = np.linalg.norm(ends[:, truth_columns(task, "object")] - objects, axis=-1)
    strayed = np.linalg.norm(truths[..., tool] - paths, axis=-1).mean(1)
    errors_cm = (100 * metres.astype(float) for metres in (missed, strayed))
    return Executed(truths[:, 0], success(task, ends), *errors_cm)
