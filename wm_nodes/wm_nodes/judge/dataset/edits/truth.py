"""What is true of recorded or edited states: how far the task got, and whether the physics can be (RA-21).

A recording is what the simulator did, of a script or of a policy: its physics holds, and no threshold is asked. A
recipe forces labels; failed_physics judges what else an edit of the states broke. It sees states at frame rate, not
the collision engine: thresholds are what a viewer of the clip could see, all in m per frame. Shapes: T frames.
"""

import numpy as np
from numpy.typing import NDArray

from wm_nodes.config.tasks import TaskRule, clip_rules
from wm_nodes.judge.dataset.edits.clips import COMPONENTS, ClipTruth, Component, LabelledClip, SceneStates, SourceClip

SUNK_M = 0.004
"""Deeper inside the table is a geometry failure; contact solvers leave less than 1 mm."""
OVERLAP_M = 0.006
"""Deeper with the point between closed finger tips inside the thing is a geometry failure."""
FLOATING_M = 0.012
"""Higher than this above the table, untouched and not falling, is a geometry failure."""
FALLING_M = 0.004
"""An untouched thing that goes down by more than this in a frame falls."""
PUSH_M = 0.004
"""A thing that gains more than this displacement per frame was pushed."""
IMPACT = 2.0
"""What is hit may go so many times as far in a frame as the tool did: 1 + restitution, which is 1 at most. In 500
recordings it went up to 2.01 times as far, and up to 54 mm further: inside a frame the tool is up to 2.6 times as fast
as over it, since the controller starts with a jerk; the cube takes that speed, and friction slows it again.
"""
SLIP_M = 0.01
"""And this much further, since nobody sees inside a frame."""
RESHAPED = 0.1
"""A relative change of size beyond this is a deformation failure."""


def tc_level(states: SceneStates, rule: TaskRule) -> int:
    """The level 0 to 4 of the last frame: 4 done, 3 nearly or there without a sub-flag, 2 half, 1 started, 0 none."""
    mover = states.thing if rule.mover == "object" else states.tool
    goal = states.goal
    if rule.above_thing_m is not None:
        goal = states.thing + np.array([0, 0, rule.above_thing_m], np.float32)
    gap = np.nan_to_num(mover - goal)
    distance = np.linalg.norm(gap, axis=1)
    low = rule.max_lift_m is None or states.bottom_m[-1] < rule.max_lift_m
    there = distance[-1] < rule.radius_m and low
    if there:
        return 4 if all(states.flags[name][-1] for name in rule.flags) else 3
    progress = (distance[0] - distance[-1]) / max(distance[0] - rule.radius_m, 1e-6)
    if progress >= rule.nearly:
        return 3
    if progress >= rule.half:
        return 2
    reach = np.linalg.norm(states.tool - states.thing, axis=1)
    touched = bool(states.contact.any() or reach[0] - reach.min() >= rule.started_m)
    return int(touched or distance[0] - distance.min() >= rule.started_m)


def failed_physics(states: SceneStates) -> frozenset[Component]:
    """The physics components that states break which no simulator made."""
    broken: set[Component] = set()
    if (np.abs(states.scales - 1) > RESHAPED).any():
        broken.add("deformation")
    if _overlaps(states).any() or _floats(states):
        broken.add("geometry")
    if _uncaused(states).any():
        broken.add("interaction")
    return frozenset(broken)


def recorded(clip: SourceClip) -> LabelledClip:
    """A clip drawn straight from the simulator: clean pixels, real physics, task as the states say."""
    level = tc_level(clip.states, clip_rules(clip.origin.task).label)
    return LabelledClip(clip, ClipTruth(dict.fromkeys(COMPONENTS, True), level))


def touched_nearby(states: SceneStates) -> NDArray[np.bool_]:
    """(T,), contact in a frame, before or after it, which explains a motion: contact is sampled once per frame."""
    near = states.contact.copy()
    near[1:] |= states.contact[:-1]
    near[:-1] |= states.contact[1:]
    return near


def overlap_m(states: SceneStates) -> NDArray[np.float64]:
    """(T,), how deep the tool point is inside thing 0; 0 where the gripper is open wider than the thing is."""
    w, x, y, z = np.moveaxis(states.poses[:, 0, 3:].astype(np.float64), 1, 0)
    offset = (states.tool - states.thing).astype(np.float64)
    axes = np.stack([  # columns of the rotation matrix: the thing's axes in the world
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
        np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
        np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
    ])
    inside = states.half_sizes_m[0] * states.scales[:, 0] - np.abs((axes * offset).sum(2).T)
    around = states.gripper_m >= 1.8 * states.half_sizes_m[0].min()
    return np.where(around, 0.0, np.maximum(inside.min(1), 0.0))


def _overlaps(states: SceneStates) -> NDArray[np.bool_]:
    return np.asarray((overlap_m(states) > OVERLAP_M) | (states.bottom_m < -SUNK_M))


def _floats(states: SceneStates) -> bool:
    """Two frames in a row above the table, untouched, and not on the way down."""
    free = (states.bottom_m > FLOATING_M) & ~touched_nearby(states)
    falling = np.diff(states.bottom_m) < -FALLING_M
    return bool((free[1:] & free[:-1] & ~falling).any())


def _uncaused(states: SceneStates) -> NDArray[np.bool_]:
    """(T - 1,), steps in which thing 0 got faster untouched, or by more than what touches it can give."""
    moved = np.diff(states.thing.astype(np.float64), axis=0)
    speed = np.linalg.norm(moved[:, :2], axis=1)
    gained = np.diff(speed, prepend=0.0)
    reach = np.linalg.norm(np.diff(states.tool.astype(np.float64), axis=0), axis=1)
    hit = np.maximum(reach, np.append(0, reach[:-1]))  # maybe at the end of the step before
    touched = touched_nearby(states)
    touched_step = touched[1:] | touched[:-1]
    return np.asarray((gained > PUSH_M) & (~touched_step | (speed > IMPACT * hit + SLIP_M)))
