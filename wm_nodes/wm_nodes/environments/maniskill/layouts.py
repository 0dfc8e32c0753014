"""Where the parts of a scene lie at the start of an episode. World frame, m. No simulator."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Point = NDArray[np.float64]
Rectangle = tuple[tuple[float, float], tuple[float, float]]
"""Least and largest x y."""
ANYWHERE: Rectangle = (-0.10, -0.13), (0.10, 0.13)
"""Where objects and carpets may lie."""
CONTAINERS: Rectangle = (-0.10, -0.16), (0.10, 0.16)
CONTAINER_CLEARANCE_M = 0.125
"""Least distance of a container's centre from what the object touches on its way: its radius, half a bar, a finger."""
MAX_TRIES = 10_000


@dataclass(frozen=True)
class Layout:
    """Where things lie on the table."""

    object: Point
    """x y."""
    object_yaw: float
    """rad."""
    container: Point
    """x y."""
    goal: Point
    """x y of the place that the task is about."""
    carpet: bool = False
    """Whether a carpet lies there."""


Place = Callable[[np.random.Generator], Layout]
"""Draws the layout of an episode."""


def draw(rng: np.random.Generator, rectangles: Sequence[Rectangle], accept: Callable[..., bool]) -> list[Point]:
    """Draw one x y from each rectangle, again and again until accept(*them). Raises RuntimeError where that does not
    come about."""
    for _ in range(MAX_TRIES):
        points = [rng.uniform(low, high) for low, high in rectangles]
        if accept(*points):
            return points
    raise RuntimeError(f"{MAX_TRIES} draws from {rectangles} were all too near to each other; make them larger")


def free_of(container: Point, start: Point, end: Point) -> bool:
    """Whether the container lies beside the straight way from start to end."""
    return distance_to_segment(container, start, end) > CONTAINER_CLEARANCE_M


def distance_to_segment(point: Point, start: Point, end: Point) -> float:
    """From a point to the nearest one between start and end."""
    way = end - start
    length = float(way @ way)
    share = np.clip((point - start) @ way / length, 0, 1) if length else 0.0
    return float(np.linalg.norm(point - start - share * way))
