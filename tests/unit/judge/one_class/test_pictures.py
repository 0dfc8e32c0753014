"""Numbers of pictures react to what they are about, and are finite of every clip."""

import math

import cv2
import numpy as np
import pytest

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.one_class.pictures import COMPONENTS, hue_masks, picture_numbers, things_in

SURFACE, RED, GREEN, ROBOT = (170, 150, 130), (200, 30, 30), (30, 160, 40), (50, 50, 50)
SIDE, T = 48, 8


def drawn(
    things: list[tuple[int, int] | None], robots: list[tuple[int, int]], colour: tuple[int, ...] = RED
) -> UInt8Array:
    """Frames (T, SIDE, SIDE, 3) with a square of 8 px and a robot of 6 px at (row, column); None: it is not there."""
    frames = np.full((len(things), SIDE, SIDE, 3), SURFACE, np.uint8)
    for frame, thing, (row, column) in zip(frames, things, robots, strict=True):
        if thing:
            frame[thing[0] : thing[0] + 8, thing[1] : thing[1] + 8] = colour
        frame[row : row + 6, column : column + 6] = ROBOT
    return frames


def pushed() -> UInt8Array:
    """The robot moves a square, which it touches from the left."""
    columns = range(10, 10 + 2 * T, 2)
    return drawn([(20, column) for column in columns], [(21, column - 7) for column in columns])


def numbers(frames: UInt8Array, reference: UInt8Array | None = None, still: bool = True) -> dict[str, float]:
    reference = pushed()[0] if reference is None else reference
    return picture_numbers(frames, reference, frames.shape[2], (still,))


def test_numbers_are_those_of_components_that_the_rubric_has() -> None:
    assert list(numbers(pushed())) == list(COMPONENTS)
    assert set(COMPONENTS.values()) <= set(load_rubric("robot").component_names)


def test_a_thing_that_the_robot_pushes_does_not_move_alone_and_one_without_a_robot_near_does() -> None:
    columns = range(10, 10 + 2 * T, 2)
    alone = drawn([(20, column) for column in columns], [(40, 4)] * T)
    assert numbers(pushed())["thing_moves_alone"] == 0
    found = numbers(alone, alone[0])
    assert found["thing_moves_alone"] == pytest.approx(2 * (T - 1))
    assert found["thing_far_of_robot"] > 20 > numbers(pushed())["thing_far_of_robot"]
    assert found["thing_jump"] == pytest.approx(2)


def test_a_thing_that_vanishes_comes_twice_or_grows_is_told_apart() -> None:
    clean = numbers(pushed())
    gone, twice, grown = pushed(), pushed(), pushed()
    gone[5:, 20:28, 20:] = SURFACE
    twice[4:, 34:42, 36:44] = RED
    grown[4:, 14:34, 18:30] = RED
    lost, second, larger = numbers(gone), numbers(twice), numbers(grown)
    assert lost["thing_lost"] > 0.8 and lost["thing_missing_end"] > -0.2 > -0.9 > clean["thing_missing_end"]
    assert second["thing_twice"] == 64 and second["thing_grown"] == 2 and clean["thing_twice"] == 0
    assert larger["thing_grown"] > 3 and clean["thing_grown"] == 1


def test_a_thing_of_another_colour_is_a_stranger_and_another_shade_changes_the_tone() -> None:
    columns = range(10, 10 + 2 * T, 2)
    places: list[tuple[int, int] | None] = [(20, column) for column in columns]
    robots = [(21, column - 7) for column in columns]
    assert numbers(drawn(places, robots, GREEN))["stranger"] == 64
    assert numbers(pushed())["stranger"] == 0
    assert numbers(drawn(places, robots, (160, 30, 30)))["thing_tone"] == 40
    assert numbers(pushed())["thing_tone"] == 0


def test_blur_of_one_frame_lowers_its_edges() -> None:
    blurred = pushed()
    blurred[4] = cv2.GaussianBlur(blurred[4], (0, 0), 1.5)
    for still in (True, False):
        assert numbers(blurred, still=still)["blurred"] > numbers(pushed(), still=still)["blurred"] + 0.3


def test_time_is_told_by_frozen_jumping_turning_back_and_flickering_frames() -> None:
    clean = numbers(pushed())
    frozen, flicker = np.repeat(pushed()[:1], T, 0), pushed()
    flicker[1::2] = np.clip(flicker[1::2].astype(int) + 20, 0, 255)
    assert numbers(frozen)["frozen"] == 0 > clean["frozen"]
    assert numbers(pushed()[[0, 1, 2, 7, 7, 7, 7, 7]])["jump"] > 2 * clean["jump"]
    assert numbers(pushed()[[0, 1, 2, 3, 2, 1, 0, 1]])["turns_back"] == 0 > clean["turns_back"]
    assert numbers(flicker)["flicker"] > 30 and numbers(flicker)["light_change"] > 15 > 2 > clean["light_change"]


def test_the_robot_is_told_by_its_area_place_and_tone() -> None:
    gone, tinted = pushed(), pushed()
    gone[4:][(gone[4:] == ROBOT).all(-1)] = SURFACE
    tinted[4:][(tinted[4:] == ROBOT).all(-1)] = (90, 90, 90)
    clean = numbers(pushed())
    assert numbers(gone)["robot_loss"] > 0.5 > clean["robot_loss"] and numbers(gone)["robot_least"] == 0
    assert numbers(tinted)["robot_tone"] == 40 and clean["robot_tone"] == 0 and clean["robot_jump"] == pytest.approx(2)


def test_a_camera_that_shifts_is_told_by_the_scenery_where_it_stands_still() -> None:
    texture = np.random.default_rng(0).uniform(-36, 36, (SIDE, SIDE)).astype(np.float32)
    textured = pushed() + cv2.GaussianBlur(texture, (0, 0), 1)[..., None]
    frames = np.clip(textured, 0, 255).astype(np.uint8)
    shifted = frames.copy()
    shifted[4:] = np.roll(frames[4:], 3, 2)
    assert numbers(frames, frames[0])["shifted"] < 0.5 and numbers(shifted, frames[0])["shifted"] > 1.5
    assert numbers(shifted, frames[0])["scenery"] > 3 * numbers(frames, frames[0])["scenery"] + 1
    assert numbers(shifted, frames[0], still=False)["shifted"] == 0, "of a camera that moves nothing is known"


def test_of_two_views_the_stranger_counts_and_they_must_move_together() -> None:
    both = np.concatenate([pushed(), pushed()], 2)
    half = both.copy()
    half[:, :, SIDE:] = half[:1, :, SIDE:]
    together, apart = (picture_numbers(f, f[0], SIDE, (True, True)) for f in (both, half))
    assert together["views_disagree"] == 0 == together["one_view_still"]
    assert apart["one_view_still"] > 1
    assert together["thing_jump"] == numbers(pushed())["thing_jump"] == apart["thing_jump"]


def test_things_are_named_by_colour_and_the_surface_is_none() -> None:
    assert things_in(pushed()[0]) == {"red": 64}
    assert things_in(np.full((SIDE, SIDE, 3), RED, np.uint8)) == {}
    assert hue_masks(pushed()).shape == (7, T, SIDE, SIDE)


CLIPS = ("grey", "black", "white", "red", "noise", "no thing", "no robot", "thing vanishes at once", "one pixel wide")


def odd_clip(name: str, frames: int, height: int, width: int) -> UInt8Array:
    rng = np.random.default_rng(0)
    levels = {"grey": 128, "black": 0, "white": 255}
    clip = np.full((frames, height, width, 3), levels.get(name, 170), np.uint8)
    if name == "red":
        clip[:] = RED
    elif name == "noise":
        clip = rng.integers(0, 256, clip.shape, np.uint8)
    elif name == "no thing":
        clip[:, 5:11, 5:11] = ROBOT
    elif name == "no robot":
        clip[:, 5:11, 5:11] = RED
    elif name == "thing vanishes at once":
        clip[0, 5:11, 5:11] = RED
    elif name == "one pixel wide":
        clip[:, 5:15, 5], clip[:, 5, 7:13] = RED, ROBOT
    return clip


@pytest.mark.parametrize("frames", [2, 3, 4, 9])
@pytest.mark.parametrize(("height", "width"), [(64, 128), (17, 46)])
def test_every_number_is_finite_of_every_clip_and_reference(frames: int, height: int, width: int) -> None:
    for name in CLIPS:
        for start in CLIPS:
            clip, reference = odd_clip(name, frames, height, width), odd_clip(start, 1, height, width)[0]
            for still in ((True, False), (True, True), (False, False)):
                found = picture_numbers(clip, reference, width // 2, still)
                assert all(map(math.isfinite, found.values())), (name, start, still, found)
