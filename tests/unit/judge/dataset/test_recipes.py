"""Clips that are wrong in a known way (RA-21). A toy drawn in NumPy stands for the renderer."""

import functools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pushed_box import FRAMES, draw, push_clip, pushing_states, redrawn

from wm_nodes.config.tasks import clip_rules
from wm_nodes.judge.agent.levels import one_hot, p_fail_of
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.dataset.edits import images
from wm_nodes.judge.dataset.edits.clips import (
    BACKGROUND,
    COMPONENTS,
    DISTRACTOR,
    OBJECT,
    PHYSICS,
    ROBOT,
    TC,
    TC_PASS_LEVEL,
    ClipTruth,
    LabelledClip,
    NotApplicableError,
    SceneStates,
)
from wm_nodes.judge.dataset.edits.generator import apply_edit, children, replay, stacks
from wm_nodes.judge.dataset.edits.recipes import RECIPES, apply, edit_states, get_recipe
from wm_nodes.judge.dataset.edits.truth import failed_physics, overlap_m, recorded, tc_level, touched_nearby

PUSH = clip_rules("push_cube").label
TOUCHING = slice(7, 12)
seeds = st.integers(0, 2**32)
names = st.sampled_from(sorted(RECIPES))


@functools.cache
def parent(recipe: str = "", severity: str = "mild") -> LabelledClip:
    """A clean push, or for a failing recipe that hides a defect one in which the robot passes through."""
    if recipe and RECIPES[recipe].on_defect and severity == "fail":
        return redrawn(parent(), edit_states(parent(), "pass_through", "fail", 0))
    return push_clip()


def child(name: str, severity: str, seed: int = 0) -> LabelledClip:
    return apply_edit(parent(name, severity), name, severity, seed, redrawn)


def change(before: LabelledClip, after: LabelledClip) -> float:
    """Mean absolute difference, grey levels."""
    return float(np.abs(before.clip.frames.astype(int) - after.clip.frames).mean())


def kinds(kind: str) -> list[str]:
    return [name for name, recipe in RECIPES.items() if recipe.kind == kind]


def failures(labels: ClipTruth) -> set[str]:
    return {name for name, passed in labels.passed.items() if not passed}


def test_labels_have_the_names_and_the_pass_level_of_the_rubric() -> None:
    rubric = load_rubric()
    assert {*COMPONENTS, TC} == set(rubric.component_names)
    assert {recipe.pattern for recipe in RECIPES.values()} - {None} == set(rubric.hack.patterns)
    assert [p_fail_of(one_hot(level)) < 0.5 for level in range(5)] == [level >= TC_PASS_LEVEL for level in range(5)]


def test_every_component_and_every_pattern_has_a_recipe_that_fails_it() -> None:
    assert {name for recipe in RECIPES.values() for name in recipe.fails} == set(COMPONENTS)
    assert Counter(recipe.pattern for recipe in RECIPES.values() if recipe.pattern).keys() == {
        "occlusion", "motion", "background", "physics",
    }


@pytest.mark.parametrize("name", RECIPES)
def test_mild_passes_fail_fails_and_mild_changes_less(name: str) -> None:
    recipe, mild, fail = RECIPES[name], child(name, "mild"), child(name, "fail")
    assert mild.labels == parent().labels and mild.labels.overall and mild.severity == "mild"
    assert {*recipe.fails} <= failures(fail.labels) and not fail.labels.overall and fail.severity == "fail"
    assert not {part for part in recipe.unknown if fail.labels.components.get(part)}, "unknown, yet labelled as passed"
    assert fail.labels.tc_level <= recipe.tc_cap and fail.labels.pattern == (recipe.pattern or None)
    assert 0 < change(parent(), mild) < change(parent(name, "fail"), fail)
    assert fail.root == mild.root == parent().sha256 and fail.recipe == mild.recipe == name


@pytest.mark.parametrize("name", RECIPES)
def test_an_edit_is_the_same_byte_for_byte_and_another_by_another_seed(name: str) -> None:
    first, again, other = child(name, "fail"), child(name, "fail"), child(name, "fail", seed=1)
    assert first.clip.frames.tobytes() == again.clip.frames.tobytes() and first.edits == again.edits
    low, high = RECIPES[name].fail
    assert low == high or first.edits[-1].amount != other.edits[-1].amount
    assert low <= first.edits[-1].amount <= high


@given(name=names, severity=st.sampled_from(["mild", "fail"]), seed=seeds)
@settings(max_examples=40, deadline=None)
def test_labels_follow_from_the_recipe_whatever_the_seed(name: str, severity: str, seed: int) -> None:
    try:
        clip = child(name, severity, seed)
    except NotApplicableError:
        return  # e.g. a repeat too near the end to be seen
    recipe = RECIPES[name]
    assert clip.clip.frames.shape == parent().clip.frames.shape
    if severity == "mild":
        assert clip.labels == parent().labels
        return
    base = parent(name, severity).labels
    forced = set(recipe.fails) | failures(base)
    assert set(recipe.fails) <= failures(clip.labels)
    extra = failures(clip.labels) - forced - {TC}
    assert extra <= (set(PHYSICS) if recipe.kind == "S" else set())
    assert set(COMPONENTS) - set(clip.labels.components) <= set(recipe.unknown) | (
        set(PHYSICS) if recipe.hides_motion else set()
    )


@pytest.mark.parametrize(
    ("name", "touched"),
    [
        *[(name, {BACKGROUND, DISTRACTOR}) for name in ("flatten", "smooth", "table_swap")],
        ("declutter", {DISTRACTOR}), ("object_recolour", {OBJECT}), ("object_vanish", {OBJECT}),
        ("object_copy", {BACKGROUND}), ("arm_tint", {ROBOT}), ("arm_cut", {ROBOT}),
    ],
)
def test_masks_are_respected(name: str, touched: set[int]) -> None:
    for severity in ("mild", "fail"):
        before, after = parent().clip, child(name, severity).clip
        changed = (before.frames != after.frames).any(-1)
        assert set(np.unique(before.masks[changed])) <= touched and changed.any()


def test_image_kernels_worked_by_hand() -> None:
    red = np.array([[[[200.0, 30.0, 10.0]]]], np.float32)
    assert images.turn_hue(red, 120) == pytest.approx(np.array([[[[10, 200, 30]]]]), abs=0.01)
    assert images.turn_hue(np.full((1, 1, 1, 3), 77, np.float32), 50) == pytest.approx(77, abs=0.01)
    flat = np.full((1, 9, 9, 1), 100, np.float32)
    assert images.blur(flat, 1.5) == pytest.approx(100, abs=1e-3)
    spot = np.zeros((1, 9, 9, 1), np.float32)
    spot[0, 4, 4] = 1
    assert images.blur(spot, 1.0)[0, 4, 5, 0] == pytest.approx(0.3989**2 * np.exp(-0.5), rel=0.01)
    half = np.zeros((1, 9, 9), bool)
    half[:, :, :4] = True
    bright = np.where(half[..., None], flat, 255).astype(np.float32)
    assert np.array_equal(images.blur_within(bright, half, 2.0).round(3), bright)  # nothing leaks in
    hole = np.ones((2, 9, 9), bool)
    hole[:, 3:6, 3:6] = False
    frames = np.where(hole[..., None], 40, 200).astype(np.uint8).repeat(3, -1)
    assert images.plate(frames, hole) == pytest.approx(40, abs=0.01)


def test_another_table_comes_after_one_third_of_the_clip() -> None:
    for name in ("table_swap", "declutter"):
        changed = (parent().clip.frames != child(name, "fail").clip.frames).any((1, 2, 3))
        assert changed.tolist() == [t >= round(FRAMES / 3) for t in range(FRAMES)]


@pytest.mark.parametrize("name", kinds("T"))
def test_time_recipes_show_frames_of_the_clip_and_keep_its_length(name: str) -> None:
    before, after = parent().clip, child(name, "fail").clip
    assert after.frames.shape == before.frames.shape and len(after.states) == FRAMES
    if name == "jitter":
        return  # its frames are moved, the test below looks at its states
    shown = [int((before.frames == frame).all((1, 2, 3)).argmax()) for frame in after.frames]
    assert (before.frames[shown] == after.frames).all()
    assert np.array_equal(after.states.thing, before.states.thing[shown])
    assert np.array_equal(after.masks, before.masks[shown])


def test_a_frozen_clip_has_no_motion_and_ends_where_it_began() -> None:
    frozen = child("freeze", "fail")
    assert not np.diff(frozen.clip.frames.astype(int), axis=0).any() and frozen.labels.tc_level == 0
    still = child("jitter", "fail")
    assert not np.diff(still.clip.states.thing, axis=0).any() and still.labels.tc_level == 0


def test_a_slowed_clip_is_worth_what_it_shows_and_a_splice_nothing() -> None:
    slowed = child("slow", "fail")
    assert slowed.labels.tc_level == tc_level(slowed.clip.states, PUSH) < TC_PASS_LEVEL
    spliced = child("splice", "fail")
    assert tc_level(spliced.clip.states, PUSH) == 4 and spliced.labels.tc_level == 1
    assert failures(spliced.labels) == {"temporal", TC}


def test_camera_recipes_move_masks_and_tracks_with_the_picture() -> None:
    for name in ("camera_shift", "camera_roll", "camera_zoom"):
        clip, middle = child(name, "fail").clip, FRAMES // 2
        places = np.argwhere(clip.masks[middle] == OBJECT)
        assert places.min() > 1 and places.max() < 94, "the box has left the view"
        assert clip.tracks["object"][middle] == pytest.approx(places.mean(0), abs=1.0)
        assert clip.tracks["object"][middle] != pytest.approx(parent().clip.tracks["object"][middle], abs=2.0)


@pytest.mark.parametrize("name", kinds("S"))
def test_state_recipes_are_pure_and_what_they_force_agrees_with_the_verifier(name: str) -> None:
    states = parent().clip.states
    before = {key: np.array(value) for key, value in vars(states).items() if key != "flags"}
    edit, mild = edit_states(parent(), name, "fail", 3), edit_states(parent(), name, "mild", 3)
    assert all(np.array_equal(getattr(states, key), value, equal_nan=True) for key, value in before.items())
    assert not failed_physics(states) and not failed_physics(mild.states)
    seen = {  # the states alone cannot tell a second thing from clutter, nor an early lift from a grasp
        "pass_through": {"geometry"}, "levitation": {"geometry"}, "second_copy": set(),
    }.get(name, set(RECIPES[name].fails))
    assert seen <= failed_physics(edit.states)


def test_state_edits_worked_by_hand() -> None:
    states = parent().clip.states

    def after(name: str, seed: int = 0) -> tuple[np.ndarray, float]:
        edit = edit_states(parent(), name, "fail", seed)
        return edit.states, edit.edit.amount

    ghost, _ = after("ghost_motion")
    assert np.ptp(ghost.robot_q, axis=0).max() == 0 and np.array_equal(ghost.thing, states.thing)
    assert not ghost.contact.any() and np.array_equal(ghost.tool, np.tile(states.tool[:1], (FRAMES, 1)))
    through, _ = after("pass_through")
    assert np.ptp(through.thing, axis=0).max() == 0 and np.array_equal(through.robot_q, states.robot_q)
    early, lead = after("early_motion")
    assert np.allclose(early.thing[5, 0], np.interp(5 + lead, np.arange(FRAMES), states.thing[:, 0]))
    moved, distance = after("teleport")
    offset = np.linalg.norm(moved.thing - states.thing, axis=1)
    assert set(np.round(offset, 4)) == {0.0, np.round(np.float32(distance), 4)} and 0.045 <= distance <= 0.06
    lower, depth = after("sunk")
    assert np.allclose(lower.bottom_m, -depth)
    pulled, share = after("pulled_in")
    assert np.allclose(pulled.thing[8, 0] - states.thing[8, 0], -share * 0.032, atol=1e-6)
    assert np.array_equal(pulled.thing[:6], states.thing[:6])  # until it is touched
    longer, factor = after("stretch")
    assert np.prod(longer.scales[-1, 0]) == pytest.approx(1, rel=1e-5) and np.allclose(longer.bottom_m, 0, atol=1e-6)
    assert longer.scales[-1, 0].max() == pytest.approx(max(1 + factor, np.sqrt(1 + factor)), rel=1e-5) or (
        longer.scales[-1, 0].min() == pytest.approx(1 / (1 + factor), rel=1e-5)
    )
    double, apart = after("second_copy")
    assert double.poses.shape[1] == 2 and np.allclose(np.abs(double.poses[:, 1, 1] - double.poses[:, 0, 1]), apart)
    lifted, height = after("levitation")
    assert np.allclose(lifted.bottom_m[-1], height) and np.allclose(lifted.bottom_m[:13], 0)


def test_hiding_needs_something_to_hide_and_splicing_a_success() -> None:
    for name in ("occlude_patch", "occlude_blur", "occlude_shadow"):
        with pytest.raises(NotApplicableError, match="has none; use a state recipe"):
            apply(parent(), name, "fail", 0)
        assert {"clarity", "geometry", "interaction"} <= failures(child(name, "fail").labels)
    with pytest.raises(NotApplicableError, match="got level 2"):
        apply(push_clip("short"), "splice", "fail", 0)


def test_a_pattern_stays_when_something_else_is_edited_on_top() -> None:
    blurred = apply(parent("occlude_patch", "fail"), "blur", "fail", 0).labels
    assert blurred.pattern == "physics" and {"clarity", "interaction"} <= failures(blurred)


def test_amounts_differ_by_recipe_severity_and_clip() -> None:
    def drawn(clip: LabelledClip, name: str, severity: str) -> float:
        low, high = getattr(RECIPES[name], severity)
        return (apply(clip, name, severity, 0).edits[-1].amount - low) / (high - low)

    shares = [drawn(parent(), name, kind) for name in ("camera_shift", "camera_roll") for kind in ("mild", "fail")]
    shares.append(drawn(push_clip(seed=1), "camera_shift", "fail"))
    assert len(set(np.round(shares, 6))) == 5


def test_an_idle_clip_has_no_motion_to_freeze_and_no_path_for_a_ghost() -> None:
    idle = push_clip("idle")
    assert idle.labels.tc_level == 0 and failures(idle.labels) == {TC}
    with pytest.raises(NotApplicableError, match="changes nothing"):
        apply(idle, "freeze", "fail", 0)
    with pytest.raises(NotApplicableError, match=r"the object moves 0\.0 cm; 3 cm are needed"):
        edit_states(idle, "ghost_motion", "fail", 0)


def test_an_object_that_the_robot_hides_to_the_end_is_not_copied() -> None:
    seen = push_clip().clip
    masks = seen.masks.copy()
    masks[1:][masks[1:] == OBJECT] = ROBOT
    hidden = recorded(replace(seen, masks=masks))
    reasons = set()
    for seed in range(9):
        with pytest.raises(NotApplicableError) as caught:
            apply(hidden, "object_copy", "fail", seed)
        reasons.add(str(caught.value))
    assert "the object is hidden to the end: nothing to copy" in reasons


def test_what_a_time_edit_may_have_cut_away_is_unknown() -> None:
    defect = parent("occlude_patch", "fail")
    assert {"interaction", "geometry"} <= failures(defect.labels)
    cut = apply(defect, "drop", "fail", 0).labels
    assert "geometry" not in cut.components and "interaction" not in cut.components and not cut.overall


def test_task_completion_levels_worked_by_hand() -> None:
    states = pushing_states()

    def ending_at(distance_m: float, lift_m: float = 0.0) -> int:
        poses = states.poses.copy()
        poses[-1, 0, 0], poses[-1, 0, 2] = 0.2 - distance_m, 0.02 + lift_m
        return tc_level(replace(states, poses=poses), PUSH)

    assert ending_at(0.099) == 4
    assert ending_at(0.099, lift_m=0.02) == 3  # in place, not on the table
    assert ending_at(0.119) == 3 and ending_at(0.121) == 2  # 0.8 of the way from 0.2 to 0.1
    assert ending_at(0.169) == 2 and ending_at(0.171) == 1
    grasped = replace(states, flags={"released": np.zeros(FRAMES, bool)})
    assert tc_level(grasped, replace(PUSH, flags=("released",))) == 3
    assert tc_level(pushing_states("idle"), PUSH) == 0

    def tool_at(height_m: float) -> int:
        tool = states.thing + np.array([0, 0, 0.3], np.float32)
        tool[-1, 2] = 0.02 + height_m
        return tc_level(replace(states, tool=tool, contact=np.zeros(FRAMES, bool)), clip_rules("reach").label)

    assert tool_at(0.099) == 4 and tool_at(0.101) == 3 and tool_at(0.18) == 2 and tool_at(0.25) == 1


def test_overlap_is_measured_in_the_frame_of_the_turned_box() -> None:
    states = pushing_states()
    tool = states.thing + np.array([0.025, 0, 0], np.float32)
    assert overlap_m(replace(states, tool=tool)).max() == 0
    turned = states.poses.copy()
    turned[:, 0, 3:] = [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]  # 45 degrees about z: its corner points along x
    assert overlap_m(replace(states, tool=tool, poses=turned)) == pytest.approx(0.02 - 0.025 * np.sqrt(0.5), abs=1e-6)


def test_the_verifier_accepts_what_robots_do() -> None:
    assert all(not failed_physics(pushing_states(behaviour)) for behaviour in ("expert", "short", "idle"))
    states = pushing_states()
    poses = states.poses.copy()
    poses[12:, 0, 0] += np.array([0, 6, 10, 12, 13, 13, 13, 13], np.float32) / 1000  # slides on and slows down
    assert not failed_physics(replace(states, poses=poses))
    lifted = states.poses.copy()
    lifted[TOUCHING, 0, 2] += 0.05
    assert not failed_physics(replace(states, poses=lifted))  # in the hand
    falling = states.poses.copy()
    falling[14:, 0, 2] += np.array([60, 45, 20, 0, 0, 0], np.float32) / 1000
    assert not failed_physics(replace(states, poses=falling))
    hanging = falling.copy()
    hanging[14:, 0, 2] = 0.08
    assert failed_physics(replace(states, poses=hanging)) == {"geometry"}
    one_touch = replace(states, contact=np.arange(FRAMES) == 7)
    assert np.flatnonzero(touched_nearby(one_touch)).tolist() == [6, 7, 8]
    around = replace(states, tool=states.thing.copy(), gripper_m=np.full(FRAMES, 0.08, np.float32))
    assert not failed_physics(around)  # an open gripper goes down around the box
    assert failed_physics(replace(around, gripper_m=np.zeros(FRAMES, np.float32))) == {"geometry"}


def knocked(cube_m: float = 0.1149, tool_m: float = 0.0608) -> SceneStates:
    """The hit in recording push_cube, seed 3195, as the simulator moved tool and cube. cube_m, tool_m: in its frame."""
    ways_m = {4: (0.0542, 0.0187), 5: (tool_m, cube_m), 6: (0.0001, 0.0152)}
    ways = np.array([ways_m.get(t, (0, 0)) for t in range(-1, FRAMES - 1)], np.float32).cumsum(0)
    states = pushing_states("idle")
    poses, tool = states.poses.copy(), states.tool.copy()
    tool[:, 0] += ways[:, 0] - 0.05
    poses[:, 0, 0] += ways[:, 1]
    return replace(states, poses=poses, tool=tool, contact=np.isin(np.arange(FRAMES), (5, 6)))


def test_what_is_hit_may_go_twice_as_far_as_the_tool() -> None:
    assert not failed_physics(knocked())  # 54 mm further than the tool
    assert not failed_physics(knocked(tool_m=0))  # hit at the end of the frame before
    assert not failed_physics(knocked(2 * 0.0608 + 0.009))
    assert failed_physics(knocked(2 * 0.0608 + 0.011)) == {"interaction"}
    assert failed_physics(replace(knocked(), contact=np.zeros(FRAMES, bool))) == {"interaction"}


def test_what_the_simulator_did_is_no_fault_of_a_recording_nor_of_an_edit() -> None:
    root = recorded(draw(knocked(0.2), push_clip().clip.origin))  # more than the rule allows an edit
    assert failed_physics(root.clip.states) == {"interaction"} and all(root.labels.components.values())
    sunk = {kind: apply_edit(root, "sunk", kind, 0, redrawn).labels for kind in ("mild", "fail")}
    assert sunk["mild"] == root.labels and failures(sunk["fail"]) - failures(root.labels) == {"geometry"}


def test_children_leave_out_what_does_not_apply_and_say_why() -> None:
    skipped: Counter[str] = Counter()
    clips = list(children(parent(), 5, None, skipped=skipped))
    assert len({clip.sha256 for clip in clips}) == len(clips) and parent().sha256 not in {c.sha256 for c in clips}
    assert not {clip.recipe for clip in clips} & set(kinds("S"))
    assert sum("no renderer" in reason for reason in skipped) == 2 * len(kinds("S"))
    assert len(list(children(parent(), 5, None, names=["blur", "blur"]))) == 2
    some = list(children(parent(), 5, redrawn, count=6))
    assert len(some) <= 6 and [c.sha256 for c in some] == [c.sha256 for c in children(parent(), 5, redrawn, count=6)]
    hidden = list(children(parent(), 5, redrawn, names=["occlude_patch", "occlude_shadow"]))
    assert [clip.severity for clip in hidden] == ["mild", "fail", "mild", "fail"]
    assert all(failures(clip.labels) & set(PHYSICS) for clip in hidden if clip.severity == "fail")


def test_stacks_are_mild_edits_of_different_components_every_other_one_on_a_physical_defect() -> None:
    made = list(stacks(parent(), 5, redrawn, 12))
    assert len(made) == len({clip.sha256 for clip in made} - {parent().sha256}) == 12
    heights = set[int]()
    for index, clip in enumerate(made):
        below, above = clip.edits[: index % 2], clip.edits[index % 2 :]
        heights.add(len(above))
        assert {edit.severity for edit in below} <= {"fail"} and {edit.severity for edit in above} == {"mild"}
        assert not {edit.recipe for edit in above} & set(kinds("S")) and {e.recipe for e in below} <= set(kinds("S"))
        touched = [name for edit in above for name in RECIPES[edit.recipe].fails]
        assert len(touched) == len(set(touched)), "two slight faults of a component may be a clear one"
        assert bool(failures(clip.labels) & set(PHYSICS)) == bool(below)
        assert below or clip.labels == parent().labels
        assert replay(parent(), clip.edits, redrawn).sha256 == clip.sha256
    assert heights == {1, 2, 3}
    assert [clip.sha256 for clip in stacks(parent(), 5, redrawn, 4)] == [clip.sha256 for clip in made[:4]]


def test_wrong_calls_name_the_value_and_the_remedy() -> None:
    with pytest.raises(ValueError, match="unknown recipe 'melt'; choose one of blur"):
        get_recipe("melt")
    with pytest.raises(ValueError, match="use edit_states, render them, then rendered"):
        apply(parent(), "sunk", "fail", 0)
    with pytest.raises(ValueError, match="'blur' edits frames; use apply"):
        edit_states(parent(), "blur", "fail", 0)
    with pytest.raises(ValueError, match="edit states before pixels and time"):
        edit_states(child("blur", "mild"), "sunk", "fail", 0)
    with pytest.raises(ValueError, match="severity must be mild or fail, got 'clean'"):
        apply(parent(), "blur", "clean", 0)
    with pytest.raises(ValueError, match="unknown task 'juggle'; choose one of all_tasks, move_to_aim, pick_place"):
        push_clip(task="juggle")
    with pytest.raises(ValueError, match="temporal unknown and nothing fails"):
        ClipTruth({name: True for name in COMPONENTS if name != "temporal"}, 4)
    clip = parent().clip
    with pytest.raises(ValueError, match=r">= 96 px high and wide, got \(64, 64\); render them larger"):
        replace(clip, frames=clip.frames[:, :64, :64], masks=clip.masks[:, :64, :64])
    with pytest.raises(ValueError, match="masks must be uint8"):
        replace(clip, masks=clip.masks + 2)
    with pytest.raises(ValueError, match=r"track 'tool' must be \(20, 2\), got \(0,\)"):
        replace(clip, tracks={"object": clip.tracks["object"]})
    with pytest.raises(ValueError, match=r"states.contact must be bool \(20,\), got float32"):
        replace(clip.states, contact=clip.states.gripper_m)


def test_ranges_of_mild_and_fail_do_not_touch() -> None:
    for recipe in RECIPES.values():
        (low, high), (fail_low, fail_high) = recipe.mild, recipe.fail
        assert low <= high and fail_low <= fail_high
        assert high < fail_low or fail_high < low, recipe.name
