"""Where the parts of a scene lie at the start of an episode. World frame, m. No simulator."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Point = NDArray[np.float64]
CONTAINER_LOW_M, CONTAINER_HIGH_M = (-0.10, -0.16), (0.10, 0.16)
CONTAINER_CLEARANCE_M = 0.125
"""Least distance of a container's centre from what the object touches on its way: its radius, half a bar, a finger."""
MAX_TRIES = 1000


@dataclass(frozen=True)
class Layout:
    """object: x y. object_yaw: rad. container: x y. goal: x y of the place that the task is about. carpet: whether a
    carpet lies there."""

    object: Point
    object_yaw: float
    container: Point
    goal: Point
    carpet: bool = False


Place = Callable[[np.random.Generator], Layout]
"""Draws the layout of an episode."""


def draw(
    rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float],
    accept: Callable[[Point], bool] = lambda point: True,
) -> Point:
    """Draw x y from a rectangle until it is accepted. Raises RuntimeError where that does not come about."""
    for _ in range(MAX_TRIES):
        point = rng.uniform(low, high)
        if accept(point):
            return point
    raise RuntimeError(f"no place between {low} and {high} is far enough from the others; make the rectangle larger")


def draw_container(rng: np.random.Generator, start: Point, end: Point) -> Point:
    """A place for the container beside the straight way from start to end."""
    return draw(
        rng, CONTAINER_LOW_M, CONTAINER_HIGH_M,
        lambda point: distance_to_segment(point, start, end) > CONTAINER_CLEARANCE_M,
    )


def distance_to_segment(point: Point, start: Point, end: Point) -> float:
    """From a point to the nearest one between start and end."""
    way = end - start
    length = float(way @ way)
    share = np.clip((point - start) @ way / length, 0, 1) if length else 0.0
    return float(np.linalg.norm(point - start - share * way))
