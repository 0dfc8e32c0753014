"""Waypoints of the tasks in the procedural scenes, and a closed loop that follows such.

A waypoint (7,) is a commanded state with its position in the world frame: x y z m, rotation vector from the tool that
points down, rad, gripper -1 closed to 1 open. P: GROUND_TRUTH_NAMES of objects.py.
"""

from collections.abc import Callable

import numpy as np

from wm_nodes.core.rotations import multiply, to_quaternion, to_vector
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill import objects
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.objects import BOTTOM, CONTAINER, GRASPED, OBJECT
from wm_nodes.environments.maniskill.table_top import GOAL

OPEN, CLOSED = 1.0, -1.0
LEAST_GRASP_M, PUSH_HEIGHT_M = 0.018, 0.02
TRAVEL_M = 0.09
"""Above a place before the tool goes down to it, and after it has gone up."""
REACHED_M, REACHED_RAD = 0.012, 0.08
MAX_TURN_RAD = 0.2
"""A script asks for a full turning action from here on."""
WAIT_STEPS = 2
"""At a waypoint where the gripper closes or opens."""
Waypoints = Callable[[FloatArray], list[FloatArray]]


def waypoint(xy: FloatArray, z: float, yaw: float, gripper: float) -> FloatArray:
    return np.array([*xy, z, 0.0, 0.0, yaw, gripper], np.float32)


def grasp_waypoints(truth: FloatArray) -> list[FloatArray]:
    """Above the object, down to it, closed, and up; the fingers close across the object's y axis. Up alone where they
    hold it already."""
    x_y, z, yaw = truth[OBJECT][:2], grasp_height(truth), grasp_yaw(truth)
    up = waypoint(x_y, z + TRAVEL_M, yaw, CLOSED)
    if truth[GRASPED]:
        return [up]
    return [waypoint(x_y, z + TRAVEL_M, yaw, OPEN), waypoint(x_y, z, yaw, OPEN), waypoint(x_y, z, yaw, CLOSED), up]


def grasp_height(truth: FloatArray) -> float:
    """Of the tool, m: the centre of the object on the table, with fingers clear of that."""
    lifted = float(truth[BOTTOM]) if truth[GRASPED] else 0.0
    return max(float(truth[OBJECT][2]) - lifted, LEAST_GRASP_M)


def grasp_yaw(truth: FloatArray) -> float:
    """Of the tool, in [-pi / 2, pi / 2): a turn of pi more grasps the same."""
    yaw = truth[objects.GROUND_TRUTH_NAMES.index("object_yaw")]
    return float((yaw + np.pi / 2) % np.pi - np.pi / 2)


def place_waypoints(truth: FloatArray) -> list[FloatArray]:
    """Grasp, and release just above the floor of the container."""
    goal, grasp_z, yaw = truth[CONTAINER], grasp_height(truth), grasp_yaw(truth)
    low = grasp_z + 0.015
    return [
        *grasp_waypoints(truth), waypoint(goal, grasp_z + TRAVEL_M, yaw, CLOSED), waypoint(goal, low, yaw, CLOSED),
        waypoint(goal, low, yaw, OPEN), waypoint(goal, grasp_z + TRAVEL_M, yaw, OPEN),
    ]


def carry_waypoints(truth: FloatArray) -> list[FloatArray]:
    """Grasp, and set down at the goal."""
    goal, z, yaw = truth[GOAL], grasp_height(truth), grasp_yaw(truth)
    return [
        *grasp_waypoints(truth), waypoint(goal, z + TRAVEL_M, yaw, CLOSED), waypoint(goal, z + 0.005, yaw, CLOSED),
    ]


def push_waypoints(truth: FloatArray, behind_m: float) -> list[FloatArray]:
    """Down behind the object, and through it to the goal, with closed fingers."""
    start, goal = truth[OBJECT][:2], truth[GOAL]
    way = (goal - start) / np.linalg.norm(goal - start)
    behind = start - behind_m * way
    return [
        waypoint(behind, TRAVEL_M, 0.0, CLOSED), waypoint(behind, PUSH_HEIGHT_M, 0.0, CLOSED),
        waypoint(goal, PUSH_HEIGHT_M, 0.0, CLOSED),
    ]


def follow(
    targets: list[FloatArray], max_action_m: float, speed: float, noise: float, rng: np.random.Generator
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return act(ground truth, state (7,)) -> action (7,) that goes to one target after the other and stays at the
    last. noise: standard deviation of it on all but the gripper."""
    reached, waited = 0, 0

    def act(_truth: FloatArray, state: FloatArray) -> FloatArray:
        nonlocal reached, waited
        target = targets[reached]
        move, turn = difference(state, target)
        if np.linalg.norm(move) < REACHED_M and np.linalg.norm(turn) < REACHED_RAD and reached < len(targets) - 1:
            waited += 1
            if waited > WAIT_STEPS or state[6] == target[6]:
                reached, waited = reached + 1, 0
                target = targets[reached]
                move, turn = difference(state, target)
        move *= min(1.0, speed * max_action_m / max(1e-9, np.abs(move).max())) / max_action_m
        action = np.concatenate([move, np.clip(turn / MAX_TURN_RAD, -1, 1)]) + rng.normal(0, noise, 6)
        return np.clip(np.append(action, target[6]), -1, 1).astype(np.float32)

    return act


def difference(state: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Translation, m, and rotation vector, rad, from a state (7,) in the base frame to a waypoint."""
    return target[:3] - (state[:3] + ROBOT_BASE), turn_between(state[3:6], target[3:6])


def turn_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """The rotation vector (3,) that turns one rotation vector (3,) into another."""
    turn: FloatArray = to_vector(np, multiply(np, to_quaternion(np, end), to_quaternion(np, -start)))
    return turn
