"""A robot that pushes a box, drawn in NumPy: recorded states, masks and tracks as the simulator gives them.

The drawing is made from the states alone, so edited states are drawn by the same function.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import FloatArray
from wm_nodes.judge.dataset.edits.clips import (
    BACKGROUND,
    DISTRACTOR,
    OBJECT,
    ROBOT,
    LabelledClip,
    Origin,
    SceneStates,
    SourceClip,
)
from wm_nodes.judge.dataset.edits.recipes import StateEdit, label_rendered
from wm_nodes.judge.dataset.edits.truth import recorded

FRAMES, SIDE = 20, 96
PX_PER_M = 300
TABLE_ROW = 64
TOUCH, RELEASE = 6, 12
HALF_M = 0.02
GRAVEL = 14
"""Grey levels by which the table's texture varies."""


def pushing_states(behaviour: str = "expert", frames: int = FRAMES) -> SceneStates:
    """expert: the box reaches the goal. short: half way. idle: nothing moves. The tool backs off afterwards."""
    speed = {"expert": 0.022, "short": 0.009, "idle": 0.0}[behaviour]
    times = np.arange(frames)
    box_x = speed * np.clip(times - TOUCH, 0, RELEASE - TOUCH)
    touching = -HALF_M - 0.012
    approach = -0.012 * np.clip(TOUCH - times, 0, None)
    tool_x = box_x + touching + approach - 0.015 * np.clip(times - RELEASE, 0, None)
    if behaviour == "idle":
        tool_x = np.full(frames, tool_x[0])
    tool = np.stack([tool_x, np.zeros(frames), np.full(frames, HALF_M)], 1).astype(np.float32)
    poses = np.zeros((frames, 1, 7), np.float32)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 0, 3] = box_x, HALF_M, 1
    return SceneStates(
        robot_q=tool.copy(), tool=tool, gripper_m=np.zeros(frames, np.float32), poses=poses,
        scales=np.ones((frames, 1, 3), np.float32), half_sizes_m=np.full((1, 3), HALF_M, np.float32),
        contact=(times >= TOUCH) & (times <= RELEASE) & (behaviour != "idle"),
        goal=np.tile(np.array([0.2, 0, np.nan], np.float32), (frames, 1)),
    )


def draw(states: SceneStates, origin: Origin) -> SourceClip:
    """Boxes seen from the front, the part inside the table hidden by it; the arm is a column over the tool."""
    ground = _table(origin.scene, origin.seed)
    frames, masks = np.tile(ground, (len(states), 1, 1, 1)), np.full((len(states), SIDE, SIDE), BACKGROUND, np.uint8)
    edges = np.arange(SIDE)

    def fill(t: int, box: tuple[float, float, float, float], colour: tuple[int, ...], label: int) -> None:
        """A rectangle (top, bottom, left, right) with smooth edges."""
        top, bottom, left, right = box
        down = np.clip(np.minimum(edges + 1, bottom) - np.maximum(edges, top), 0, 1)
        across = np.clip(np.minimum(edges + 1, right) - np.maximum(edges, left), 0, 1)
        cover = down[:, None] * across
        frames[t] += cover[..., None] * (np.array(colour) - frames[t])
        masks[t][cover > 0.5] = label

    for t in range(len(states)):
        fill(t, (72, 80, 80, 90), (200, 190, 40), DISTRACTOR)
        for k in range(states.poses.shape[1]):
            half = states.half_sizes_m[k] * states.scales[t, k]
            row, column = _pixel(states.poses[t, k, :3])
            high, width = half[2] * PX_PER_M, half[0] * PX_PER_M
            top, bottom = row - high, min(row + high, _pixel(states.poses[t, k, :3] * [1, 1, 0])[0])
            fill(t, (top, bottom, column - width, column + width), (30, 60, 210), OBJECT)
        row, column = _pixel(states.robot_q[t])
        fill(t, (0, row + 4, column - 3, column + 3), (190, 190, 195), ROBOT)
    tracks = {"object": states.poses[:, 0, :3], "tool": states.tool}
    seen = {name: np.array([_pixel(point) for point in points], np.float32) - 0.5 for name, points in tracks.items()}
    pixels = np.rint(frames).astype(np.uint8)
    return SourceClip(pixels, masks, seen, states, origin, "push the blue cube into the red target", fps=8.0)


def push_clip(behaviour: str = "expert", seed: int = 0, **origin: str) -> LabelledClip:
    """A recorded clip of the toy with its labels."""
    place = Origin("push_cube", "front", "cube/blue", "gravel", seed, behaviour)
    return recorded(draw(pushing_states(behaviour), replace(place, **origin)))


def redrawn(parent: LabelledClip, edit: StateEdit) -> LabelledClip:
    return label_rendered(parent, edit, draw(edit.states, parent.clip.origin))


def _table(scene: str, seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng([seed, *scene.encode()])
    noise = rng.integers(-GRAVEL, GRAVEL + 1, (SIDE, SIDE, 1))
    image = np.array([150.0, 120.0, 90.0]) + noise
    image[: TABLE_ROW - 30] += 30
    return image


def _pixel(point: FloatArray) -> tuple[float, float]:
    return TABLE_ROW - PX_PER_M * float(point[2]) + 150 * float(point[1]), 36 + PX_PER_M * float(point[0])
