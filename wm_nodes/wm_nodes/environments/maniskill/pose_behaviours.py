"""How an episode of a task with pose actions is acted: its waypoints as they are, or varied in one named way.

expert is the paper's optimal trajectory, only the essential waypoints; detour, interpolated and jitter are its
suboptimal ones. They are planned (planner.py); without a plan they are followed straight, as the others always are.
Those miss in the ways of a weak policy: data of mostly successes teach a world model that the object arrives.
Waypoints: states (7,) with the position in the world frame, see pose_scripts.py.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from wm_nodes.core.rotations import multiply, to_quaternion, to_vector
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.pose_scripts import CLOSED, OPEN, Waypoints, follow, turn_between, waypoint
from wm_nodes.environments.maniskill.table_top import TOOL

PLANNED = ("expert", "detour", "interpolated", "jitter")
BEHAVIOURS = (*PLANNED, "noisy", "near_miss", "over", "short", "no_grasp", "early_release", "random")
MOVING = {
    "expert": 0.3, "detour": 0.1, "interpolated": 0.1, "jitter": 0.1, "noisy": 0.14, "near_miss": 0.12, "short": 0.06,
    "over": 0.04, "random": 0.04,
}
CARRYING = {**MOVING, "near_miss": 0.08, "short": 0.04, "no_grasp": 0.03, "early_release": 0.03}
"""Usual shares of a task that grasps nothing, and of one that does."""
DETOUR_M, DETOUR_RAD = 0.08, np.deg2rad(15.0)
JITTER_M, JITTER_RAD = 0.01, np.deg2rad(5.0)
LOWEST_M = 0.012
"""Of a varied waypoint: fingers above the table."""
DETOURS_LOW_M, DETOURS_HIGH_M = (-0.25, -0.2, 0.07), (0.15, 0.2, 0.25)
"""Box of detours: what is carried passes above a container, and the arm reaches them."""
HIGH_M = 0.08
"""A waypoint from here on is in free space, a detour may lead to it."""


def vary(behaviour: str, waypoints: list[FloatArray], start: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
    """The waypoints that an episode of `behaviour` has instead of the essential ones.

    start: the commanded state, position in the world frame, from which it begins.

    Raises:
        ValueError: unknown behaviour.
    """
    if behaviour not in BEHAVIOURS:
        raise ValueError(f"unknown behaviour {behaviour!r}; choose one of {', '.join(BEHAVIOURS)}")
    points = [point.copy() for point in waypoints]
    closed = [i for i, point in enumerate(points) if point[6] == CLOSED]
    match behaviour:
        case "detour":
            return _with_detours(points, rng)
        case "interpolated":
            return _in_pieces(points, start, rng)
        case "jitter":
            return _with_jitter(points, rng)
        case "near_miss":  # of the object, or of where it goes
            begin = int(rng.choice([0, len(points) // 2]))
            angle, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.015, 0.06)
            for point in points[begin:]:
                point[:2] += away * np.array([np.cos(angle), np.sin(angle)], np.float32)
        case "over":
            height = rng.uniform(0.015, 0.07)
            for point in points:
                point[2] += height
        case "short":
            last = int(rng.integers(len(points)))
            reached = between(points[last - 1] if last else start, points[last], rng.uniform(0.2, 0.95))
            return [*points[:last], reached]
        case "no_grasp":
            for point in points:
                point[6] = OPEN
        case "early_release" if closed and points[0][6] == OPEN:
            place = int(rng.integers(closed[0] + 1, max(closed[0] + 2, closed[-1])))  # not on the last way down
            dropped = between(points[place - 1], points[place], rng.uniform(0.1, 0.7))
            points.insert(place, dropped)
            points.insert(place + 1, dropped.copy())
            for point in points[place + 1 :]:
                point[6] = OPEN
        case "random":
            return _wander(rng)
    return points


def between(start: FloatArray, end: FloatArray, share: float) -> FloatArray:
    """The waypoint at a share of the straight way, with the gripper of the end."""
    rotation = _turned(start[3:6], share * turn_between(start[3:6], end[3:6]))
    place = start[:3] + share * (end[:3] - start[:3])
    return np.asarray(np.concatenate([place, rotation, end[6:]]), np.float32)


def scripted(waypoints: Waypoints, speed: float) -> Callable[..., Callable[[FloatArray, FloatArray], FloatArray]]:
    """Return a Task.script that follows the waypoints, varied, straight. speed: largest action of a translation."""

    def script(
        behaviour: str, truth: FloatArray, rng: np.random.Generator, max_action_m: float
    ) -> Callable[[FloatArray, FloatArray], FloatArray]:
        start = waypoint(truth[TOOL][:2], truth[TOOL][2], 0.0, CLOSED)
        targets = vary(behaviour, waypoints(truth), start, rng)
        noise = rng.uniform(0.1, 0.6) if behaviour in ("noisy", "random") else 0.0
        slowness = 1.0 if behaviour in PLANNED else rng.uniform(0.6, 1.0)
        return follow(targets, max_action_m, speed * slowness, noise, rng)

    return script


def _with_detours(points: list[FloatArray], rng: np.random.Generator) -> list[FloatArray]:
    """One or two further waypoints, each on the way to one in free space."""
    free = [i for i, point in enumerate(points) if point[2] >= HIGH_M]
    for i in sorted(rng.choice(free, min(len(free), int(rng.integers(1, 3))), replace=False), reverse=True):
        extra = points[i].copy()
        extra[:3] = np.clip(extra[:3] + rng.uniform(-DETOUR_M, DETOUR_M, 3), DETOURS_LOW_M, DETOURS_HIGH_M)
        extra[3:6] = _turned(extra[3:6], rng.uniform(-DETOUR_RAD, DETOUR_RAD, 3))
        points.insert(i, extra)
    return points


def _in_pieces(points: list[FloatArray], start: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
    """Every way cut into two to four pieces of unequal length, each of which starts and ends at rest."""
    pieces = list[FloatArray]()
    for begin, end in zip([start, *points], points, strict=False):
        if not np.array_equal(begin[:6], end[:6]):
            lengths = rng.uniform(1, 3, int(rng.integers(2, 5)))
            pieces += [between(begin, end, share) for share in np.cumsum(lengths)[:-1] / lengths.sum()]
        pieces.append(end)
    return pieces


def _with_jitter(points: list[FloatArray], rng: np.random.Generator) -> list[FloatArray]:
    """Every waypoint displaced; where only the gripper moves, the tool stays."""
    moved = list[FloatArray]()
    for i, point in enumerate(points):
        if i and np.array_equal(point[:6], points[i - 1][:6]):
            moved.append(np.append(moved[-1][:6], point[6:]))
            continue
        place = point[:3] + rng.normal(0, JITTER_M, 3).astype(np.float32)
        place[2] = max(place[2], LOWEST_M)
        rotation = _turned(point[3:6], rng.normal(0, JITTER_RAD, 3))
        moved.append(np.concatenate([place, rotation, point[6:]]).astype(np.float32))
    return moved


def _turned(rotation: FloatArray, turn: np.ndarray[Any, np.dtype[Any]]) -> FloatArray:
    """A rotation vector (3,) after a further turn (3,) about the base's axes, rad."""
    turned = multiply(np, to_quaternion(np, turn), to_quaternion(np, rotation))
    return np.asarray(to_vector(np, turned), np.float32)


def _wander(rng: np.random.Generator) -> list[FloatArray]:
    low, high = [-0.15, -0.15, 0.02], [0.2, 0.15, 0.2]
    return [
        waypoint(place[:2], place[2], rng.uniform(-0.5, 0.5), rng.choice([CLOSED, OPEN]))
        for place in rng.uniform(low, high, (100, 3))
    ]
