"""Scripted behaviours for data: experts, and every way of missing that a weak policy shows.

A behaviour is a closed loop on simulator truth: action (3,) in [-1, 1] from the ground truth and the commanded tool
position. Data of mostly successes teach a world model that "the cube arrives"; so most behaviours fail near contact.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.table_top import CUBE, CUBE_HALF_SIZE_M, GOAL, above_cube

ROBOT_BASE = np.array([-0.615, 0.0, 0.0], np.float32)
CLEARANCE_M = 0.045
"""From the cube's centre to the tool before it touches: half the cube and half the closed fingers, plus a margin."""
TRAVEL_HEIGHT_M = 0.10
PUSH_HEIGHT_M = 0.02


@dataclass(frozen=True)
class Style:
    """How an episode is acted. Lengths in m, noise in normalised action units."""

    lateral_m: float = 0.0
    """The tool passes this far beside the cube's centre line."""
    height_m: float = 0.0
    """Added to the pushing height; 0.05 passes over the cube."""
    noise: float = 0.0
    """Standard deviation."""
    stop_short_m: float = 0.0
    """The push ends this far before the goal's edge is reached."""
    detours: int = 0
    """Unrelated waypoints before the task."""
    speed: float = 1.0
    """Share of the largest action."""


EXPERT = Style()


def sample_style(behaviour: str, rng: np.random.Generator) -> Style:
    """Draw a style of `behaviour`; raises ValueError for an unknown name."""
    sign = rng.choice([-1.0, 1.0])
    match behaviour:
        case "expert" | "hover":
            return EXPERT
        case "noisy" | "hover_noisy":
            return Style(noise=rng.uniform(0.1, 0.8), lateral_m=rng.normal(0, 0.008), speed=rng.uniform(0.5, 1.0))
        case "near_miss":
            lateral_m = sign * rng.uniform(0.015, 0.06)
            return Style(lateral_m=lateral_m, noise=rng.uniform(0, 0.25), speed=rng.uniform(0.6, 1))
        case "over":
            return Style(height_m=rng.uniform(0.015, 0.07), lateral_m=rng.normal(0, 0.01), noise=rng.uniform(0, 0.3))
        case "short":
            return Style(stop_short_m=rng.uniform(0.0, 0.1), lateral_m=rng.normal(0, 0.01), noise=rng.uniform(0, 0.2))
        case "detour":
            return Style(detours=int(rng.integers(1, 3)), noise=rng.uniform(0, 0.3), lateral_m=rng.normal(0, 0.01))
        case "random":
            return Style(detours=100, noise=rng.uniform(0, 0.5))
    raise ValueError(f"unknown behaviour {behaviour!r}; choose one of {', '.join(BEHAVIOURS)}")


BEHAVIOURS = ("expert", "noisy", "near_miss", "over", "short", "detour", "random", "hover", "hover_noisy")


def script(
    behaviour: str, truth: FloatArray, rng: np.random.Generator, max_action_m: float
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return act(ground_truth (P,), state (3,)) -> action (3,) for one episode that starts at `truth`."""
    style = sample_style(behaviour, rng)
    waypoints = list(_waypoints(behaviour, style, truth, rng))
    reached = 0

    def act(truth_now: FloatArray, state: FloatArray) -> FloatArray:
        nonlocal reached
        tool = state + ROBOT_BASE
        while reached < len(waypoints) - 1 and np.linalg.norm(waypoints[reached] - tool) < 0.012:
            reached += 1
        target = above_cube(truth_now) if behaviour.startswith("hover") and not style.noise else waypoints[reached]
        step = (target - tool) / max_action_m
        largest = np.abs(step).max()
        if largest > style.speed:
            step = step * (style.speed / largest)
        return np.clip(step + rng.normal(0, style.noise, 3), -1, 1).astype(np.float32)

    return act


def _waypoints(behaviour: str, style: Style, truth: FloatArray, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Yield world tool positions (3,) of the episode; the tool stays at the last one."""
    cube = truth[CUBE]
    for _ in range(style.detours):
        yield _near(cube, rng)
    if behaviour.startswith("hover"):
        yield above_cube(truth) + rng.normal(0, 0.02 if style.noise else 0.0, 3).astype(np.float32)
        for _ in range(6 if style.noise else 0):
            yield _near(cube, rng)
        return
    yield from push_waypoints(truth, style)


def push_waypoints(truth: FloatArray, style: Style = EXPERT) -> list[FloatArray]:
    """Above the start of the push, down, and along to the goal; pulling is pushing from the other side."""
    cube, goal = truth[CUBE], truth[GOAL]
    direction = np.sign(goal[0] - cube[0])
    push_z = PUSH_HEIGHT_M + style.height_m
    side = cube[1] + style.lateral_m
    start_x = cube[0] - direction * (CLEARANCE_M + 0.02)
    distance = abs(goal[0] - cube[0]) - 0.06 - style.stop_short_m
    touch = CUBE_HALF_SIZE_M + 0.01
    end_x = cube[0] + direction * (distance - touch)
    places = [(start_x, max(TRAVEL_HEIGHT_M, push_z)), (start_x, push_z), (end_x, push_z)]
    return [np.array([x, side, z], np.float32) for x, z in places]


def _near(cube: FloatArray, rng: np.random.Generator) -> FloatArray:
    offset = rng.uniform([-0.14, -0.10, 0.0], [0.22, 0.10, 0.12])
    return np.array([cube[0] + offset[0], cube[1] + offset[1], 0.02 + offset[2]], np.float32)
