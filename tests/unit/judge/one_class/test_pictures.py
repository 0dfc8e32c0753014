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


def test_a_thing_that_vanishes_or_gets_more_while_nothing_is_near_is_told_from_one_that_is_pushed() -> None:
    clean, gone, alone = numbers(pushed()), pushed(), drawn([(20, 30)] * T, [(40, 4)] * T)
    gone[5:, 20:28, 20:] = SURFACE
    assert numbers(gone)["thing_end"] > -0.1 > -0.9 > clean["thing_end"]
    lost, second = alone.copy(), alone.copy()
    lost[4:, 20:28, 30:38] = SURFACE
    second[4:, 34:42, 36:44] = RED
    still = numbers(alone, alone[0])
    assert numbers(lost, alone[0])["thing_lost_alone"] == 1 == numbers(second, alone[0])["thing_gained_alone"]
    assert still["thing_lost_alone"] == 0 == still["thing_gained_alone"]


def beside(side: int = 8, blur_px: float = 0.0, from_frame: int = 4) -> UInt8Array:
    """The pushed square, and a moving camera that shows it 24 px wide, from a frame on side / 8 times as high."""
    near = drawn([None] * T, [(0, 0)] * T)
    for frame, high in zip(near, [24] * from_frame + [3 * side] * (T - from_frame)):
        frame[8 : 8 + high, 12:36] = RED
    if blur_px:
        near = np.stack([cv2.GaussianBlur(frame, (0, 0), blur_px) for frame in near])
    return np.concatenate([pushed(), near], 2)


def of_both(frames: UInt8Array) -> dict[str, float]:
    return picture_numbers(frames, beside()[0], SIDE, (True, False))


def test_a_thing_that_gets_longer_where_the_camera_moves_is_told_from_one_that_keeps_its_shape() -> None:
    assert of_both(beside())["thing_long"] == pytest.approx(3, abs=0.1)
    assert of_both(beside(side=13))["thing_long"] == pytest.approx(39 / 8, abs=0.1)
    assert of_both(beside(side=4))["thing_long"] == pytest.approx(3, abs=0.1), "until then it had its length"


def test_a_thing_that_is_blurred_where_the_camera_moves_has_no_sharp_edge() -> None:
    assert of_both(beside())["thing_blurred"] < -0.65
    assert of_both(beside(blur_px=2))["thing_blurred"] > -0.4


def test_a_thing_that_is_hidden_from_one_camera_is_seen_by_the_other_and_one_that_shrinks_in_both_is_not() -> None:
    hidden, shrunk = beside(), beside(side=1)
    hidden[4:, 20:28, :SIDE] = SURFACE
    shrunk[4:, 22:28, :SIDE] = SURFACE
    assert of_both(hidden)["thing_end"] < -0.9 < -0.4 < of_both(shrunk)["thing_end"]


def test_a_thing_that_is_only_paler_than_its_surface_has_no_colour_to_follow() -> None:
    clip = np.full((T, SIDE, SIDE, 3), (100, 30, 30), np.uint8)
    clip[:, 5:11, 5:11] = (170, 100, 100)
    found = numbers(clip, clip[0])
    assert found["thing_end"] == 0 == found["thing_blurred"] and things_in(clip[0]) == {"red": 36}


def test_a_thing_that_is_stretched_while_nothing_is_near_changes_its_shape() -> None:
    alone = drawn([(20, 30)] * T, [(40, 4)] * T)
    stretched = alone.copy()
    stretched[4:, 16:32, 32:36] = RED
    assert numbers(alone, alone[0])["thing_shape"] == 1
    assert numbers(stretched, alone[0])["thing_shape"] > 1.2


def test_a_thing_of_another_colour_is_a_stranger() -> None:
    columns = range(10, 10 + 2 * T, 2)
    places: list[tuple[int, int] | None] = [(20, column) for column in columns]
    assert numbers(drawn(places, [(21, column - 7) for column in columns], GREEN))["stranger"] == 64
    assert numbers(pushed())["stranger"] == 0


def test_light_and_tint_are_compared_with_the_reference() -> None:
    dark, warm = pushed() // 2, np.clip(pushed() + np.array([20, 0, -20]), 0, 255).astype(np.uint8)
    clean = numbers(pushed())
    assert numbers(dark)["light"] > 60 > 1 > clean["light"] and numbers(warm)["tint"] > 0.1 > 0.01 > clean["tint"]


def test_blur_of_one_frame_lowers_its_edges() -> None:
    blurred = pushed()
    blurred[4] = cv2.GaussianBlur(blurred[4], (0, 0), 1.5)
    for still in (True, False):
        assert numbers(blurred, still=still)["blurred"] > numbers(pushed(), still=still)["blurred"] + 0.3


def test_a_robot_that_vanishes_is_told_by_its_least_area() -> None:
    gone = pushed()
    gone[4:][(gone[4:] == ROBOT).all(-1)] = SURFACE
    assert numbers(gone)["robot_least"] == 0 > -0.5 > numbers(pushed())["robot_least"]


def test_a_camera_that_shifts_is_told_by_the_scenery_where_it_stands_still() -> None:
    texture = np.random.default_rng(0).uniform(-36, 36, (SIDE, SIDE)).astype(np.float32)
    textured = pushed() + cv2.GaussianBlur(texture, (0, 0), 1)[..., None]
    frames = np.clip(textured, 0, 255).astype(np.uint8)
    shifted = frames.copy()
    shifted[4:] = np.roll(frames[4:], 3, 2)
    assert numbers(shifted, frames[0])["scenery"] > 3 * numbers(frames, frames[0])["scenery"] + 1
    assert numbers(shifted, frames[0], still=False)["scenery"] == 0, "of a camera that moves nothing is known"


def test_of_two_views_the_stranger_one_counts() -> None:
    both = np.concatenate([pushed(), drawn([(20, 30)] * T, [(21, 23)] * T)], 2)
    both[:, :, SIDE:][4:, 21:27, 23:29] = SURFACE
    assert picture_numbers(both, both[0], SIDE, (True, True))["robot_least"] == 0


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


@pytest.mark.slow
@pytest.mark.parametrize("frames", [2, 3, 4, 9])
@pytest.mark.parametrize(("height", "width"), [(64, 128), (17, 46)])
def test_every_number_is_finite_of_every_clip_and_reference(frames: int, height: int, width: int) -> None:
    for name in CLIPS:
        for start in CLIPS:
            clip, reference = odd_clip(name, frames, height, width), odd_clip(start, 1, height, width)[0]
            for still in ((True, False), (True, True), (False, False)):
                found = picture_numbers(clip, reference, width // 2, still)
                assert all(map(math.isfinite, found.values())), (name, start, still, found)
