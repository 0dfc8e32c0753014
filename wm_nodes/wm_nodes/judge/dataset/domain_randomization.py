"""Cameras, colours, light and push directions of training clips, drawn from ranges instead of lists.

What the benchmark holds out stays out of the ranges by a stated distance, and part of them is kept for validation
episodes (RESERVED_*), so that judging cameras, colours, tables and directions never trained on is measured without the
test part. Everything follows from task, seed and part, in numbers that the set's manifest has in full.
"""

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from wm_nodes.config.tasks import clip_rules
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.dataset.edits.clips import Origin
from wm_nodes.judge.dataset.edits.manifest import Part
from wm_nodes.judge.dataset.rendering import CAMERAS, Layout, SceneAppearance, View

T = TypeVar("T")
Triple = tuple[float, float, float]

HELD_OUT_CAMERA = "near_high"
PULL_DEGREES = 180.0
"""The heading of pull_cube, whose goal lies towards the robot."""
CAMERA_GAP_M, HUE_GAP_DEGREES, TABLE_GAP, HEADING_GAP_DEGREES = 0.15, 30.0, 0.12, 60.0
"""What is drawn is at least so far from what is held out: eye from eye; hue; RGB, Euclidean; heading."""
PURPLE_HUE_DEGREES = 282.0
MOSS: Triple = (0.5, 0.58, 0.42)

TARGET_M: Triple = (0.05, 0.0, 0.015)
"""Cameras look at a point within TARGET_JITTER_M of this."""
TARGET_JITTER_M = (0.03, 0.03, 0.015)
DISTANCE_M, ELEVATION_DEGREES, AZIMUTH_DEGREES = (0.5, 0.62), (25.0, 65.0), (-90.0, 90.0)
"""Of the eye from TARGET_M; azimuth from +x, which is away from the robot, to +y. From further back the hand hides the
object: beyond 90 degrees in 34 to 44 % of the frames of 52 recordings, within in 8 % or less of 56.
"""
HUES_DEGREES = {"orange": (14.0, 30.0), "yellow": (42.0, 58.0), "green": (105.0, 150.0), "blue": (205.0, 240.0)}
"""Of the objects, by the word of the instruction. Red is the target's."""
SATURATION, BRIGHTNESS = (0.7, 0.95), (0.35, 0.9)
TABLE_SATURATION, TABLE_BRIGHTNESS = (0.0, 0.35), (0.35, 0.9)
CONTRAST, CLUTTER, AMBIENT, LAMP = (0.02, 0.3), (1, 5), (0.15, 0.45), (0.0, 0.4)
"""Of the tiles, half of the range of their brightness; number of things; strength of lights."""
CENTRE_M, CENTRE_JITTER_M, BEHIND_M = (0.05, 0.0), (0.07, 0.06), 0.07
"""A push leads past a point near this; the cube starts that far before it."""

RESERVED_EYE_M: Triple = (0.26, -0.30, 0.50)
"""near_high as in a mirror: eyes within RESERVED_CAMERA_M are of validation episodes only."""
RESERVED_CAMERA_M = 0.2
RESERVED_COLOUR = "yellow"
RESERVED_TABLE: Triple = (0.58, 0.45, 0.5)
"""Tables within TABLE_GAP of this are of validation episodes only."""
RESERVED_HEADING_DEGREES = 90.0
"""Headings beyond this are of validation episodes only."""
FACTORS = ("camera", "object", "table", "heading")


@dataclass(frozen=True)
class RandomizedScene:
    """One episode's scene. colour: the word of the instruction. look.layout: None where the task's own is kept.
    reserved: the FACTORS that no training episode has like this.
    """

    view: View
    colour: str
    look: SceneAppearance
    reserved: tuple[str, ...]

    def origin(self, task: str, seed: int, behaviour: str) -> Origin:
        """All numbers of the scene as the names of a manifest's origin."""
        (eye, target), look = self.view, self.look
        lamp = "" if look.lamp is None else f" lamp {_text(look.lamp[0])} {look.lamp[1]:g}"
        if look.layout is not None:
            behaviour += f" from {_text(look.layout.cube_m)} heading {look.layout.heading_rad:g}"
        return Origin(
            task, f"drawn {_text(eye)} to {_text(target)}", f"cube/{self.colour} {_text(look.thing)}",
            f"drawn {_text(look.table)} shades {_text(look.shades)} clutter {look.num_clutter} ambient "
            f"{look.ambient:g}{lamp}", seed, behaviour,
        )


def draw_scene(task: str, seed: int, part: Part) -> RandomizedScene:
    """Draw the scene of an episode.

    Training episodes have nothing that is reserved; those of validation have each factor reserved in half of the
    draws, so that each can be measured with and without it.
    """
    rng = numpy_stream(seed, f"diverse_look/{task}")
    wanted = {name: part == "validation" and rng.random() < 0.5 for name in FACTORS}
    view = _draw_until(
        lambda: _draw_view(rng),
        lambda v: camera_gap_m(v) >= CAMERA_GAP_M
        and (_distance(v[0], RESERVED_EYE_M) <= RESERVED_CAMERA_M) == wanted["camera"],
    )
    others = [name for name in HUES_DEGREES if name != RESERVED_COLOUR]
    colour = RESERVED_COLOUR if wanted["object"] else str(rng.choice(others))
    thing = _hsv(rng.uniform(*HUES_DEGREES[colour]), rng.uniform(*SATURATION), rng.uniform(*BRIGHTNESS))
    table = _draw_until(
        lambda: _hsv(rng.uniform(0, 360), rng.uniform(*TABLE_SATURATION), rng.uniform(*TABLE_BRIGHTNESS)),
        lambda t: _distance(t, MOSS) >= TABLE_GAP and (_distance(t, RESERVED_TABLE) <= TABLE_GAP) == wanted["table"],
    )
    contrast, clutter = rng.uniform(*CONTRAST), int(rng.integers(CLUTTER[0], CLUTTER[1] + 1))
    ambient, strength = (round(float(rng.uniform(*limits)), 3) for limits in (AMBIENT, LAMP))
    side = rng.uniform(0, 2 * np.pi)
    lamp = (_round3((np.cos(side), np.sin(side), -1.0)), strength)
    shades = (round(0.95 - contrast, 3), round(0.95 + contrast, 3))
    layout, turned = None, False
    if clip_rules(task).any_heading:
        turned = wanted["heading"]
        layout = _draw_layout(rng, (RESERVED_HEADING_DEGREES, PULL_DEGREES - HEADING_GAP_DEGREES) if turned
                         else (0.0, RESERVED_HEADING_DEGREES))
    reserved = tuple(name for name in FACTORS if (turned if name == "heading" else wanted[name]))
    look = SceneAppearance(thing, table, clutter, seed, shades, ambient, lamp, layout)
    return RandomizedScene(view, colour, look, reserved)


def camera_gap_m(view: View) -> float:
    """How far a camera's eye is from the one that is held out."""
    return _distance(view[0], CAMERAS[HELD_OUT_CAMERA][0])


def hue_degrees(colour: Triple) -> float:
    return 360 * colorsys.rgb_to_hsv(*colour)[0]


def _draw_view(rng: np.random.Generator) -> View:
    distance, (up, side) = rng.uniform(*DISTANCE_M), np.radians([rng.uniform(*ELEVATION_DEGREES), rng.uniform(
        *AZIMUTH_DEGREES)])
    way = np.array([np.cos(up) * np.cos(side), np.cos(up) * np.sin(side), np.sin(up)])
    target = np.array(TARGET_M) + rng.uniform(-1, 1, 3) * TARGET_JITTER_M
    return _round3(TARGET_M + distance * way), _round3(target)


def _draw_layout(rng: np.random.Generator, turn_degrees: tuple[float, float]) -> Layout:
    """A way past the workspace's centre, turned by so much to either side."""
    heading = round(float(np.radians(rng.uniform(*turn_degrees)) * rng.choice([-1.0, 1.0])), 4)
    centre = np.array(CENTRE_M) + rng.uniform(-1, 1, 2) * CENTRE_JITTER_M
    x, y = centre - BEHIND_M * np.array([np.cos(heading), np.sin(heading)])
    return Layout((round(float(x), 3), round(float(y), 3)), heading)


def _draw_until(draw: Callable[[], T], fits: Callable[[T], bool]) -> T:
    while not fits(value := draw()):
        pass
    return value


def _distance(a: Triple, b: Triple) -> float:
    return float(np.linalg.norm(np.subtract(a, b)))


def _hsv(hue_degrees: float, saturation: float, brightness: float) -> Triple:
    return _round3(colorsys.hsv_to_rgb(hue_degrees / 360, saturation, brightness))


def _round3(values: ArrayLike) -> Triple:
    x, y, z = (round(float(value), 3) for value in np.asarray(values))
    return x, y, z


def _text(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)
