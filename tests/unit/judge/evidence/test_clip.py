"""Evidence reacts to what it is about, in the right direction, and not to something else (RA-17)."""

import functools
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from evidence_table import EVIDENCE
from pushed_box import HALF_M, draw, push_clip, pushing_states, redrawn

from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.judge.dataset.edits.clips import LabelledClip, SourceClip
from wm_nodes.judge.dataset.edits.recipes import apply, edit_states
from wm_nodes.judge.evidence.motion import motion_evidence, outline_of
from wm_nodes.judge.evidence.objects import FAR, find_target, object_evidence, scene_of
from wm_nodes.judge.evidence.pictures import pictures_of
from wm_nodes.judge.evidence.pixels import pixel_evidence
from wm_nodes.judge.evidence.regions import region_evidence
from wm_nodes.judge.evidence.registration import camera_moves
from wm_nodes.judge.evidence.segmentation import OBJECT, ROBOT
from wm_nodes.judge.evidence.tracks import second_areas, track

INSTRUCTION = "push the blue cube into the red target"


@functools.cache
def clean() -> LabelledClip:
    return push_clip("expert")


def numbers(clip: SourceClip) -> dict[str, float]:
    """All evidence, with the drawn masks in place of found ones; the clean clip's first frame is the reference."""
    reference = clean().clip
    return evidence_of(clip.frames, reference.frames[0], np.concatenate([reference.masks[:1], clip.masks]))


def evidence_of(frames: UInt8Array, reference: UInt8Array, masks: UInt8Array) -> dict[str, float]:
    """What clip_evidence returns for given masks."""
    pictures, scene = pictures_of(frames, reference), scene_of(masks)
    return {
        **pixel_evidence(pictures), **object_evidence(scene, reference, INSTRUCTION),
        **region_evidence(pictures, masks, INSTRUCTION), **motion_evidence(scene, outline_of(scene, pictures.colours)),
    }


@functools.cache
def of_clean() -> dict[str, float]:
    return numbers(clean().clip)


def edited(name: str) -> dict[str, float]:
    """Evidence of the clean clip after the failing version of a recipe."""
    if name in STATES:
        return numbers(redrawn(clean(), edit_states(clean(), name, "fail", 1)).clip)
    return numbers(apply(hidden() if name == "occlude_patch" else clean(), name, "fail", 1).clip)


def hidden() -> LabelledClip:
    """A clip with a physical defect that is worth hiding."""
    return redrawn(clean(), edit_states(clean(), "sunk", "fail", 1))


STATES = {"ghost_motion", "teleport", "sunk", "levitation", "stretch", "pulled_in", "pass_through"}
REACTS: dict[str, tuple[dict[str, float], tuple[str, ...]]] = {
    # recipe: evidence and the least change it must show (sign: direction), then what must not react
    "blur": ({"sharpness_mean": -0.15, "detail_mean": -0.3}, ("gain_mean", "hue_last", "object_net", "flicker")),
    "dark": ({"gain_mean": -0.4}, ("hue_last", "object_net", "flicker")),
    "bright": ({"gain_mean": 0.3}, ("object_net", "flicker")),
    "flicker": ({"flicker": 0.2}, ("object_net", "sharpness_first")),
    "hue_drift": ({"hue_last": 15, "hue_drift": 15}, ("hue_first", "object_net", "flicker")),
    "object_recolour": ({"object_hue_turn": 40, "named_hue_off": 30}, ("scene_away_mean", "gain_mean")),
    "arm_tint": ({"robot_repainted": 20}, ("object_hue_turn", "scene_away_mean")),
    "camera_shift": ({"camera_shift": 5}, ("gain_mean", "flicker")),
    "camera_roll": ({"camera_turn": 5}, ("gain_mean", "flicker")),
    "camera_zoom": ({"camera_growth": 0.1}, ("gain_mean", "flicker")),
    "freeze": ({"motion_still": 0.3, "motion_mean": -0.5}, ("gain_mean", "sharpness_mean", "hue_first")),
    "shuffle": ({"order_wrong": 0.2, "order_detour": 0.5}, ("gain_mean", "sharpness_mean", "object_area_free")),
    "flatten": ({"scene_texture": -0.3, "scene_spread": -0.3}, ("object_hue_turn", "object_net", "flicker")),
    "table_swap": ({"scene_offset_last": 30, "scene_offset_step": 30}, ("object_hue_turn", "scene_away_first")),
    "occlude_patch": ({"darkened_mean": 0.01}, ("gain_mean", "flicker")),
    "ghost_motion": ({"moved_apart": 2, "gap_onset": 0.3}, ("gain_mean", "sharpness_mean")),
    "teleport": ({"object_step": 0.3, "moved_apart_step": 0.9, "jump_unhit": 0.3},
                 ("gain_mean", "sharpness_mean", "object_area_free")),
    "sunk": ({"object_height_max": -0.2}, ("gain_mean", "object_second")),
    "levitation": ({"after_touch_rise": 0.5}, ("gain_mean", "object_second")),
    "stretch": ({"outline_tall_seen_last": -0.15}, ("gain_mean", "jump_alone", "pulled_sum", "pass_through")),
    "pulled_in": ({"pulled_step": 0.3, "jump_against": 0.3}, ("gain_mean", "outline_tall_clear_max")),
    "pass_through": ({"pass_through": 0.3, "pass_near_fast": -0.3}, ("gain_mean", "outline_tall_clear_max")),
}


@pytest.mark.parametrize("recipe", REACTS)
def test_evidence_reacts_to_its_defect_and_stays_where_it_was_otherwise(recipe: str) -> None:
    wanted, unmoved = REACTS[recipe]
    found, before = edited(recipe), of_clean()
    for name, least in wanted.items():
        change = found[name] - before[name]
        assert change * np.sign(least) >= abs(least), f"{name}: {before[name]:.3f} -> {found[name]:.3f}"
    for name in unmoved:
        assert found[name] == pytest.approx(before[name], abs=0.06 + 0.06 * abs(before[name])), name


def test_a_clean_clip_agrees_with_its_reference_and_the_push_is_caused() -> None:
    found = of_clean()
    assert found["gain_mean"] == pytest.approx(1, abs=0.02) and found["sharpness_mean"] == pytest.approx(1, abs=0.1)
    assert found["camera_shift"] < 1.5 and found["scene_away_mean"] < 1
    assert found["moved_apart"] == 0 and found["object_second"] == 0
    assert found["object_net"] == pytest.approx(0.022 * 6 / (2 * HALF_M), rel=0.1)  # six steps of 2.2 cm, sizes of 4 cm


def test_the_colour_at_an_edge_tells_parts_of_a_pixel() -> None:
    """Half-covered rows at both ends of a blue box make it one pixel taller: 11 px for 10, and a tenth more area."""
    grey, blue = np.array([150, 150, 150]), np.array([40, 60, 200])
    pictures = np.full((3, 96, 96, 3), grey, np.uint8)
    masks = np.zeros((3, 96, 96), np.uint8)
    pictures[:, 40:50, 30:40], masks[:, 40:50, 30:40] = blue, OBJECT
    pictures[2, [39, 50], 30:40] = (grey + blue) // 2
    scene = scene_of(masks)
    found = motion_evidence(scene, outline_of(scene, pictures))
    assert found["outline_area_seen_last"] == pytest.approx(0, abs=1e-6), "the median of three is a sharp one"
    assert found["outline_area_step"] == pytest.approx(np.log(1.1), abs=0.02)
    assert found["outline_tall_step"] == pytest.approx(np.log(11 / 10), abs=0.02) and found["outline_wide_step"] < 1e-6
    assert found["jump_alone"] == 0 and found["hollow_max"] == 0


def test_a_late_jump_is_one_that_no_tool_hit_and_a_hit_is_none() -> None:
    """A box of 10 px goes 8 px right in one step, the robot's tip 8 px left of it follows, or stands still."""
    pictures = np.full((9, 96, 96, 3), 150, np.uint8)
    masks = np.zeros((2, 9, 96, 96), np.uint8)
    for t in range(9):
        left = 40 + 8 * (t > 5)
        pictures[t, 50:60, left : left + 10] = (40, 60, 200)
        masks[:, t, 50:60, left : left + 10] = OBJECT
    masks[0, :, 20:58, 26:30] = ROBOT
    for t in range(9):
        masks[1, t, 20:58, 26 + 8 * (t > 5) : 30 + 8 * (t > 5)] = ROBOT
    free, hit = (motion_evidence(one, outline_of(one, pictures)) for one in map(scene_of, masks))
    assert free["jump_sudden"] == hit["jump_sudden"] == pytest.approx(0.8, abs=0.01)
    assert free["jump_unhit"] == free["still_jump"] == pytest.approx(0.8, abs=0.01)
    assert hit["jump_unhit"] <= 0.05 and hit["still_jump"] == 0 and hit["jump_sudden_closing"] > 0.7
    assert free["jump_sudden_pulled"] < -0.7, "away from the tool"


MOVES = [(0.8, 0, 0, 0), (0, -0.6, 0, 0), (0, 0, 0.015, 0), (0, 0, 0, 0.02), (0.3, 0.2, 0.01, -0.01)]


@pytest.mark.parametrize("move", MOVES)
def test_a_known_camera_motion_is_measured(move: tuple[float, ...]) -> None:
    """The second picture shows at x what the first shows at x - u(x): right, down, turn, growth about the middle."""
    waves = np.random.default_rng(0).uniform(-0.4, 0.4, (12, 2))

    def picture(across: FloatArray, along: FloatArray) -> FloatArray:
        heights = [20 * np.sin(p * across + q * along + 9 * p) for p, q in waves]
        return np.sum(heights, axis=0, dtype=np.float32)

    along, across = (grid - 23.5 for grid in np.indices((48, 48)).astype(np.float32))
    right, down, turn, growth = move
    u, v = right + turn * along + growth * across, down - turn * across + growth * along
    pair = np.stack([picture(across, along), picture(across - u, along - v)])
    (found,), (left,) = camera_moves(pair, np.ones((1, 48, 48), np.float32))
    assert found * [1, 1, 24, 24] == pytest.approx(np.array(move) * [1, 1, 24, 24], abs=0.05)  # px at the border
    assert left < 0.1 * np.abs(pair[1] - pair[0]).mean()


def noise(seed: int, *shape: int) -> UInt8Array:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


@pytest.mark.parametrize(
    "make",
    [
        lambda: noise(0, 2, 10, 14, 3), lambda: noise(0, 3, 96, 96, 3), lambda: np.zeros((2, 8, 8, 3), np.uint8),
        lambda: np.full((9, 200, 120, 3), 255, np.uint8), lambda: np.repeat(noise(1, 1, 50, 70, 3), 12, 0),
    ],
    ids=["tiny noise", "noise", "black", "white", "still"],
)
def test_every_number_is_finite_for_any_length_size_and_content(make: Callable[[], UInt8Array]) -> None:
    frames = make()
    for value in (0, 2):
        masks = np.full((len(frames) + 1, *frames.shape[1:3]), value, np.uint8)
        found = evidence_of(frames, frames[0], masks)
        assert {name: v for name, v in found.items() if not np.isfinite(v)} == {}
        assert set(found) == set(EVIDENCE)
        low, high = np.array([EVIDENCE[name] for name in found]).T
        outside = (np.array(list(found.values())) < low) | (np.array(list(found.values())) > high + 1e-6)
        assert [name for name, bad in zip(found, outside) if bad] == []


def test_wrong_shapes_are_named() -> None:
    frames = noise(0, 4, 32, 32, 3)
    with pytest.raises(ValueError, match=r"T >= 2.*\(1, 32, 32, 3\)"):
        pictures_of(frames[:1], frames[0])
    with pytest.raises(ValueError, match=r"reference frame must be uint8 \(32, 32, 3\), got uint8 \(16, 16, 3\)"):
        pictures_of(frames, frames[0, :16, :16])
    with pytest.raises(ValueError, match="float32"):
        pictures_of(frames.astype(np.float32), frames[0])


def test_blobs_are_measured_alike_wherever_they_are_and_the_first_of_equals_counts() -> None:
    """An ell of 12 px, a square of 9 and a dot, at every place of a window of 2 x 2 px and in a corner."""
    ell = np.zeros((10, 14), bool)
    ell[0, :6], ell[1:7, 0] = True, True
    ell[4:7, 4:7], ell[9, 13] = True, True
    for row, column in ((0, 0), (6, 7), (7, 6), (7, 7), (22, 18)):
        mask = np.zeros((2, 32, 32), bool)
        mask[0, row : row + 10, column : column + 14] = ell
        found = track(mask)
        assert found.area[0] == 12 and found.second[0] == second_areas(mask)[0] == 9
        assert found.centre[0] == pytest.approx([row + 21 / 12, column + 15 / 12], rel=1e-15)
        assert found.box[0].tolist() == [row, column, 7, 6]
        assert np.isnan(found.area[1]) and found.second[1] == second_areas(mask)[1] == 0
    twins = np.zeros((1, 16, 16), bool)
    twins[0, 3:6, 9:12] = twins[0, 3:6, 3:6] = True
    assert track(twins).box[0].tolist() == [3, 3, 3, 3]


def test_the_target_is_where_it_was_drawn_and_distance_one_is_its_edge() -> None:
    picture = np.full((96, 96, 3), 150, np.uint8)
    cv2.ellipse(picture, (60, 40), (24, 12), 0, 0, 360, (210, 40, 40), -1)
    cv2.ellipse(picture, (60, 40), (12, 6), 0, 0, 360, (240, 240, 240), -1)
    target = find_target(picture, np.zeros((96, 96), np.uint8), "red")
    assert target is not None
    points = np.array([[40.0, 60.0], [40.0, 84.0], [52.0, 60.0], [40.0, 12.0]])
    assert target.distance(points) == pytest.approx([0, 1, 1, 2], abs=0.1)
    assert find_target(picture, np.zeros((96, 96), np.uint8), "green") is None


def test_progress_towards_the_target_is_none_at_the_start_and_whole_at_its_edge() -> None:
    states = pushing_states("expert")
    clip = draw(states, clean().clip.origin)
    reference = clip.frames[0].copy()
    column = 36 + 300 * 0.2  # of the goal, pushed_box draws 300 px per m
    cv2.circle(reference, (round(column), 64 - 6), 24, (210, 40, 40), -1)
    masks = np.concatenate([clip.masks[:1], clip.masks])
    found = object_evidence(scene_of(masks), reference, INSTRUCTION)
    assert found["asks_above"] == 0 and found["target_end"] < 1 < found["target_start"] < FAR
    assert found["target_progress"] > 0.9
    idle = object_evidence(scene_of(np.repeat(clip.masks[:1], 5, 0)), reference, INSTRUCTION)
    assert idle["target_progress"] == 0 and idle["target_end"] == idle["target_start"]


def test_an_instruction_without_colours_asks_for_no_target_and_says_so() -> None:
    clip = clean().clip
    masks = np.concatenate([clip.masks[:1], clip.masks])
    found = object_evidence(scene_of(masks), clip.frames[0], "move the gripper above the blue cube")
    assert found["asks_above"] == 1 and found["target_end"] == FAR
    assert region_evidence(pictures_of(clip.frames, clip.frames[0]), masks, "do it")["named_hue_off"] == 0
