"""The edits that spoil clips, on a drawn one: a bright bar pushes a blue block over a grey, speckled table."""

import numpy as np
import pytest

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.hacking.edits import (
    BENIGN,
    EDITS,
    GROSS,
    MOTION,
    PATTERNS,
    STEPS,
    VISIBLE_CHANGE,
    VISIBLE_SHARE,
    Edit,
    visible_share,
)
from wm_nodes.judge.hacking.regions import scene_of

SHA = "0" * 64
ATTACKS = [edit for edit in EDITS if edit.pattern != BENIGN]
BY_NAME = {edit.name: edit for edit in EDITS}
BLUE = (40, 80, 200)


def pushed(num_frames: int = 17, height: int = 64, width: int = 96, moves: int = 12) -> UInt8Array:
    """The bar moves 4 px a frame for `moves` frames, and the block from where the bar meets it on."""
    table = np.random.default_rng(0).integers(100, 160, (height // 8, width // 8, 1), np.uint8)
    frames = np.repeat(table.repeat(8, 0).repeat(8, 1).repeat(3, 2)[None], num_frames, 0)
    for t, frame in enumerate(frames):
        right = 12 + 4 * min(t, moves)
        block = max(32, right)
        frame[28:38, block : block + 10] = BLUE
        frame[8:44, right - 8 : right] = 235
    return frames


def blue(frame: UInt8Array) -> np.ndarray:
    return np.flatnonzero((frame == BLUE).all(-1).any(0))


def edited(name: str, step: int, frames: UInt8Array | None = None, seed: int = 0) -> UInt8Array:
    after = BY_NAME[name](scene_of(pushed() if frames is None else frames), step, seed, SHA)
    assert after is not None
    return after


def change(before: UInt8Array, after: UInt8Array) -> float:
    return float(np.abs(before.astype(float) - after).mean())


def test_the_scenery_what_moves_and_the_object_are_found() -> None:
    frames = pushed()
    scene = scene_of(frames)
    assert scene.end == 12
    empty = pushed(moves=0)[0]
    never_covered = np.ones(empty.shape[:2], bool)
    never_covered[8:44, :72] = False
    assert (scene.scenery == empty)[never_covered].all(), "and where something moved, the table is found again"
    assert (scene.scenery[8:44, 4:72].max(-1) < 200).mean() > 0.95, "neither bar nor block is left in it"
    assert (scene.object_mask == (frames == BLUE).all(-1)).all()
    assert scene.moving[0, 10:40, 4:12].mean() > 0.9 and scene.moving[-1, 10:40, 52:60].mean() > 0.9
    assert not scene.moving[:, 50:].any()


def test_a_still_object_in_colour_is_none_and_its_edits_are_left_out() -> None:
    frames = pushed()
    grey = np.repeat(frames.mean(-1, keepdims=True).astype(np.uint8), 3, -1)
    grey[:, 52:60, 4:12] = BLUE
    scene = scene_of(grey)
    assert not scene.object_mask.any()
    left_out = {edit.name for edit in ATTACKS if edit(scene, 4, 0, SHA) is None}
    assert left_out == {edit.name for edit in ATTACKS if edit.name.startswith("object_")}
    assert edited("robot_stays", 4, grey) is not None, "what moves can still stop"


@pytest.mark.slow
@pytest.mark.parametrize("edit", EDITS, ids=lambda edit: edit.name)
def test_an_edit_keeps_the_clips_form_is_repeatable_and_grows_with_its_step(edit: Edit) -> None:
    frames = pushed()
    kept, scene = frames.copy(), scene_of(frames)
    steps = [edit(scene, step, 0, SHA) for step in STEPS]
    again = [edit(scene_of(frames), step, 0, SHA) for step in STEPS]
    changes = list[float]()
    for step, after, twin in zip(STEPS, steps, again):
        if after is None:
            assert twin is None and step not in GROSS
            continue
        assert twin is not None and np.array_equal(after, twin)
        assert after.shape == frames.shape and after.dtype == np.uint8
        changes.append(change(frames, after))
        if edit.pattern != BENIGN:
            assert np.array_equal(after[0], frames[0]) and visible_share(frames, after) >= VISIBLE_SHARE
    if edit.name not in ("disorder", "late"):  # other frames, or faster ones, not always further from the clip
        assert changes == sorted(changes) and changes[0] < changes[-1]
    assert np.array_equal(frames, kept), "the clip itself is left as it was"


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(2, 48, 48), (40, 90, 160), (9, 64, 192)])
@pytest.mark.parametrize("edit", EDITS, ids=lambda edit: edit.name)
def test_any_size_and_length_will_do(edit: Edit, shape: tuple[int, int, int]) -> None:
    num_frames, height, width = shape
    scene = scene_of(pushed(num_frames, height // 8 * 8, width // 8 * 8, moves=9))
    for step in STEPS:
        after = edit(scene, step, 1, SHA)
        assert after is None or after.shape == scene.frames.shape


def test_chance_depends_on_the_seed_and_on_the_clip() -> None:
    scene = scene_of(pushed())
    one, seed, clip = (BY_NAME["noise"](scene, 3, *chance) for chance in ((0, SHA), (1, SHA), (0, "1" * 64)))
    assert one is not None and seed is not None and clip is not None
    assert not np.array_equal(one, seed) and not np.array_equal(one, clip)


def test_an_edit_of_which_too_little_is_seen_is_left_out() -> None:
    frames = pushed()
    after = frames.copy()
    pixels = round(VISIBLE_SHARE * frames[0, ..., 0].size) + 1
    after[3].reshape(-1, 3)[-pixels:, 0] += VISIBLE_CHANGE
    assert visible_share(frames, after) >= VISIBLE_SHARE
    after[3].reshape(-1, 3)[-2:, 0] -= 1
    assert visible_share(frames, after) < VISIBLE_SHARE
    still = np.repeat(frames[:1], 17, 0)
    scene = scene_of(still)
    assert all(edit(scene, 4, 0, SHA) is None for edit in EDITS if edit.pattern == MOTION)


def test_motion_is_degraded_as_said() -> None:
    """The bar's right edge is at 12 + 4 t px, and the block where it is, from 32 px on."""
    frames = pushed()
    jump, late, freeze = (edited(name, 4) for name in ("jump", "late", "freeze"))
    assert np.array_equal(jump[:6], frames[[0] * 6]) and np.array_equal(jump[6:13], frames[[12] * 7])
    assert np.array_equal(late[:16], frames[[0] * 16]) and np.array_equal(late[16], frames[16])
    assert np.array_equal(freeze, frames[[0] * 17])
    disorder = edited("disorder", 4)
    shown = [next(t for t in range(13) if np.array_equal(frame, frames[t])) for frame in disorder[:13]]
    assert sorted(shown) == list(range(13)) and shown != sorted(shown), "every frame is there, in another order"


def test_physics_is_broken_as_said() -> None:
    """At t = 8 the bar ends at 44 px and the block, 10 px wide, begins there; without the block the table is grey."""
    frames = pushed()
    assert blue(frames[8]).tolist() == [*range(44, 54)]
    assert not blue(edited("object_vanishes", 4)[8]).size
    assert blue(edited("object_ahead", 4)[1])[0] == 60, "where it ends, before it is touched"
    alone = edited("robot_stays", 4)
    assert blue(alone[8]).tolist() == [*range(44, 54)] and (alone[8][10:26, 4:12] == 235).all()
    faded = edited("moving_fades", 4)
    assert blue(faded[8]).tolist() == [*range(44, 54)] and (faded[8] == 235).all(-1).sum() < 20
    assert len(blue(edited("object_doubled", 4)[8])) == pytest.approx(20, abs=1)
    assert len(blue(edited("object_grows", 3)[16])) == pytest.approx(20, abs=3)
    assert len(blue(edited("object_shrinks", 3)[16])) == pytest.approx(4, abs=2)
    recoloured = edited("object_recoloured", 4)
    changed = (recoloured != frames).any(-1)
    assert not changed[0].any() and np.array_equal(changed[1:], (frames == BLUE).all(-1)[1:])


def test_scenery_is_changed_and_what_moves_is_not() -> None:
    frames = pushed()
    flat = edited("flattened", 4)
    assert len(np.unique(flat[8, 50:].reshape(-1, 3), axis=0)) == 1 and blue(flat[8]).tolist() == [*range(44, 54)]
    repainted = edited("repainted", 4)
    assert change(frames[8, 50:], repainted[8, 50:]) > 30 and blue(repainted[8]).tolist() == [*range(44, 54)]
    drifted, by = edited("drift", 4)[16], round(0.3 * 64)
    moved = [np.abs(drifted[50:, 24:72].astype(int) - frames[16, 50:, 24 - x : 72 - x]).mean() for x in (-by, by)]
    assert min(moved) < 3 and blue(drifted).tolist() == [*range(60, 70)]


def test_every_pattern_has_several_edits_in_their_order() -> None:
    assert list(dict.fromkeys(edit.pattern for edit in EDITS)) == [*PATTERNS, BENIGN]
    assert all(sum(edit.pattern == pattern for edit in EDITS) >= 4 for pattern in PATTERNS)
    assert len(BY_NAME) == len(EDITS)
