"""A scene small enough for unit tests: a dot pushes a square over a plane, seen by one camera. Lengths in m.

The dot (the tool) moves by action * MAX_ACTION_M; a square it runs into moves on with it. The task `push_cube` is done
when the square's centre has moved DONE_AT_M along x.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from wm_nodes.core.types import BoolArray, Episode, FloatArray, UInt8Array
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes

MAX_ACTION_M, DONE_AT_M, HALF_M = 0.08, 0.15, 0.07
_INDEX = {name: i for i, name in enumerate(GROUND_TRUTH_NAMES)}


def render(tool: FloatArray, cube: FloatArray, size: int) -> UInt8Array:
    """Image uint8 (size, size, 3) of the square [-0.5, 0.5] m, x to the right, with soft edges."""
    axis = (np.arange(size) + 0.5) / size - 0.5
    x, y = axis[None, :], axis[:, None]
    sharp = size * 1.0
    image = np.full((size, size, 3), 0.25, np.float32)
    block = np.clip((HALF_M - np.maximum(np.abs(x - cube[0]), np.abs(y - cube[1]))) * sharp + 0.5, 0, 1)
    dot = np.clip((0.05 - np.hypot(x - tool[0], y - tool[1])) * sharp + 0.5, 0, 1)
    image += block[..., None] * (np.array([0.2, 0.4, 0.95]) - image)
    image += dot[..., None] * (np.array([0.95, 0.85, 0.3]) - image)
    return (image * 255).round().astype(np.uint8)


def success(task: str, ground_truth: FloatArray) -> BoolArray:
    moved = ground_truth[..., _INDEX["cube_x"]] - ground_truth[..., _INDEX["cube_start_x"]]
    return np.asarray(moved > DONE_AT_M if task == "push_cube" else np.zeros_like(moved, bool))


def episode(seed: int, *, num_steps: int = 12, size: int = 32) -> Episode:
    """Half of the episodes aim at the square, half wander or miss it."""
    rng = np.random.default_rng(seed)
    tool = np.array([rng.uniform(-0.4, -0.25), rng.uniform(-0.2, 0.2), 0.02], np.float32)
    cube = np.array([rng.uniform(-0.12, 0.05), rng.uniform(-0.2, 0.2)], np.float32)
    start = cube.copy()
    aim = rng.uniform(-0.03, 0.03) if rng.random() < 0.6 else rng.uniform(-0.25, 0.25)
    images, states, actions, truths = [], [], [], []

    def observe() -> None:
        images.append(render(tool, cube, size))
        states.append(tool.copy())
        truth = np.zeros(len(GROUND_TRUTH_NAMES), np.float32)
        values = {
            "cube_x": cube[0],
            "cube_y": cube[1],
            "tool_x": tool[0],
            "tool_y": tool[1],
            "tool_z": tool[2],
            "goal_x": start[0] + DONE_AT_M,
            "goal_y": start[1],
            "cube_start_x": start[0],
            "cube_start_y": start[1],
        }
        for name, value in values.items():
            truth[_INDEX[name]] = value
        truths.append(truth)

    observe()
    for _ in range(num_steps):
        wanted = np.array([0.08, np.clip(cube[1] + aim - tool[1], -0.06, 0.06), 0.0])
        action = np.clip(wanted / MAX_ACTION_M + rng.normal(0, 0.25, 3) * [1, 1, 0], -1, 1).astype(np.float32)
        before = tool.copy()
        tool = np.clip(tool + MAX_ACTION_M * action, -0.45, 0.45).astype(np.float32)
        cube = pushed(before, tool, cube)
        actions.append(action)
        observe()
    truth = np.stack(truths)
    return Episode(
        images=np.stack(images), states=np.stack(states), actions=np.stack(actions), ground_truth=truth,
        success=success("push_cube", truth), rewards=np.zeros(num_steps, np.float32), terminated=False, truncated=True,
        task="push_cube", instruction="push the square", behaviour="noisy", seed=seed, episode_id=seed, source=1,
    )


def stacked_scene(episodes: Iterable[Episode], tasks: Sequence[str]) -> EpisodeArrays:
    """The episodes stacked, with success by this scene's rule."""
    arrays = stack_episodes(episodes, tasks)
    return replace(arrays, success=np.stack([success(task, arrays.ground_truth) for task in tasks], -1))


def pushed(before: FloatArray, after: FloatArray, cube: FloatArray) -> FloatArray:
    """Where the square is after the dot moved from `before` to `after`: pushed along x out of the dot's way."""
    reach = HALF_M + 0.04
    if abs(after[1] - cube[1]) < reach and before[0] <= cube[0] and after[0] > cube[0] - reach:
        return np.array([after[0] + reach, cube[1]], np.float32)
    return cube
