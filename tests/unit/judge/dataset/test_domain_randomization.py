"""Training clips of drawn cameras, colours and directions: held out stays held out, reserved stays unseen."""

import re
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest

from wm_nodes.config.load import load_config
from wm_nodes.judge.dataset.build import (
    BENCHMARK,
    HELD_OUT,
    OBJECT_COLOURS,
    TABLES,
    LabelledClipSource,
    SetPlan,
    instruction_of,
)
from wm_nodes.judge.dataset.domain_randomization import (
    CAMERA_GAP_M,
    FACTORS,
    HEADING_GAP_DEGREES,
    HUE_GAP_DEGREES,
    MOSS,
    PULL_DEGREES,
    PURPLE_HUE_DEGREES,
    RESERVED_CAMERA_M,
    RESERVED_COLOUR,
    RESERVED_EYE_M,
    RESERVED_HEADING_DEGREES,
    RESERVED_TABLE,
    TABLE_GAP,
    RandomizedScene,
    draw_scene,
    hue_degrees,
)
from wm_nodes.judge.dataset.edits.clips import OBJECT, Origin
from wm_nodes.judge.dataset.edits.manifest import Part
from wm_nodes.judge.dataset.edits.truth import failed_physics
from wm_nodes.judge.dataset.rendering import CAMERAS, SceneAppearance

pytestmark = pytest.mark.rendering
CONFIG = load_config("cpu").simulation
SEEDS = range(1500)
PLAN = SetPlan(num_episodes=60, seed=20_000, development=True, diverse=True)


def drawn(task: str = "push_cube", part: Part = "train") -> list[RandomizedScene]:
    return [draw_scene(task, seed, part) for seed in SEEDS]


def of_set(seed: int) -> RandomizedScene:
    return draw_scene("push_cube", seed, PLAN.part("push_cube", seed))


@pytest.fixture(scope="module")
def source() -> Iterator[LabelledClipSource]:
    made = LabelledClipSource("push_cube", CONFIG, diverse=True)
    yield made
    made.close()


@pytest.mark.parametrize("part", ["train", "validation"])
@pytest.mark.parametrize("task", ["push_cube", "pull_cube", "reach"])
def test_nothing_that_is_drawn_comes_near_what_the_benchmark_holds_out(task: str, part: Part) -> None:
    assert HELD_OUT.objects == ("cube/purple",)
    assert TABLES[HELD_OUT.scenes[0]] == MOSS
    assert hue_degrees(OBJECT_COLOURS["purple"]) == pytest.approx(PURPLE_HUE_DEGREES, abs=1)
    high = np.array(CAMERAS[HELD_OUT.cameras[0]][0])
    for variation in drawn(task, part):
        assert np.linalg.norm(variation.view[0] - high) >= CAMERA_GAP_M
        assert abs(hue_degrees(variation.look.thing) - PURPLE_HUE_DEGREES) >= HUE_GAP_DEGREES
        assert np.linalg.norm(np.subtract(variation.look.table, MOSS)) >= TABLE_GAP
        assert variation.colour not in ("purple", "red") and (variation.look.layout is None) == (task != "push_cube")
        heading = 0.0 if variation.look.layout is None else np.degrees(variation.look.layout.heading_rad)
        assert PULL_DEGREES - abs(heading) >= HEADING_GAP_DEGREES - 0.01
        origin = variation.origin(task, 0, "expert")
        assert HELD_OUT.held_out(origin) is None and f" {variation.colour} cube" in instruction_of(origin)


def unseen(variation: RandomizedScene) -> set[str]:
    """The factors of a push that lie where no training episode may be, by the written distances."""
    look = variation.look
    assert look.layout is not None
    found = {
        "camera": np.linalg.norm(np.subtract(variation.view[0], RESERVED_EYE_M)) <= RESERVED_CAMERA_M,
        "object": variation.colour == RESERVED_COLOUR,
        "table": np.linalg.norm(np.subtract(look.table, RESERVED_TABLE)) <= TABLE_GAP,
        "heading": np.degrees(abs(look.layout.heading_rad)) > RESERVED_HEADING_DEGREES + 0.01,
    }
    return {name for name, kept in found.items() if kept}


def test_validation_has_each_reserved_factor_in_half_of_its_draws_and_training_has_none() -> None:
    assert not any(unseen(variation) for variation in drawn())
    held = drawn(part="validation")
    assert all(unseen(variation) == set(variation.reserved) for variation in held)
    for name in FACTORS:
        assert sum(name in v.reserved for v in held) / len(held) == pytest.approx(0.5, abs=0.05), name


def test_a_diverse_set_has_no_test_part_and_its_origins_hold_all_numbers() -> None:
    parts = Counter(HELD_OUT.part(Origin("push_cube", "", "", "", seed)) for seed in PLAN.seeds("push_cube"))
    assert parts.keys() == {"train", "validation"} and parts.total() == 60
    variation = draw_scene("push_cube", 20_000, "train")
    origin, look, layout = variation.origin("push_cube", 20_000, "expert"), variation.look, variation.look.layout
    assert layout is not None and look.lamp is not None
    for text, numbers in (
        (origin.camera, [*variation.view[0], *variation.view[1]]),
        (origin.object_id, look.thing),
        (origin.scene, [*look.table, *look.shades, look.num_clutter, look.ambient, *look.lamp[0], look.lamp[1]]),
        (origin.behaviour, [*layout.cube_m, layout.heading_rad]),
    ):
        assert [float(number) for number in re.findall(r"-?\d+\.?\d*", text)] == pytest.approx(list(numbers), abs=1e-9)
    with pytest.raises(ValueError, match="leave out shapes"):
        SetPlan(shapes=("post",), development=True, diverse=True)
    with pytest.raises(ValueError, match="pull_cube is held out, a development set has none of it"):
        SetPlan(("push_cube", "pull_cube"), division=BENCHMARK.division, development=True)


def test_a_development_set_is_the_part_of_a_whole_one_that_training_reads() -> None:
    whole, part = SetPlan(num_episodes=100, seed=1000), SetPlan(num_episodes=30, seed=1000, development=True)
    assert whole.seeds("push_cube") == list(range(1000, 1100))
    kept = [seed for seed in whole.seeds("push_cube") if whole.part("push_cube", seed) != "test"]
    assert part.seeds("push_cube") == kept[:30] and 30 <= len(kept) < 50


def test_a_push_goes_where_it_was_headed_and_is_the_same_each_time(source: LabelledClipSource) -> None:
    seed = next(
        s for s in PLAN.seeds("push_cube") if source.origin(s).behaviour.startswith("expert")
        and abs(of_set(s).look.layout.heading_rad) > 1
    )
    found = source.clip(seed)
    states, layout = found.clip.states, of_set(seed).look.layout
    assert layout is not None and found.labels.tc_level == 4 and not failed_physics(states)
    assert states.thing[0, :2] == pytest.approx(layout.cube_m, abs=1e-3)
    way, goal = (place - states.thing[0, :2] for place in (states.thing[-1, :2], states.goal[0, :2]))
    assert np.linalg.norm(goal) == pytest.approx(0.2, abs=1e-3)
    for ahead in (way, goal):
        assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(layout.heading_rad, abs=0.15)
    rows, columns = np.nonzero(found.clip.masks[0] == OBJECT)
    assert found.clip.tracks["object"][0] == pytest.approx([rows.mean(), columns.mean()], abs=3.0)
    assert source.clip(seed).sha256 == found.sha256


def test_clutter_lies_beside_the_way_and_a_drawn_scene_leaves_no_trace(source: LabelledClipSource) -> None:
    clip = source.clip(20_000).clip
    states, plain = clip.states.at(np.array([0])), SceneAppearance(seed=1)

    def picture() -> bytes:
        drawing = source.stage.draw(
            states.robot_q, states.poses, states.half_sizes_m * states.scales, states.tool, states.goal, "near_side",
            plain,
        )
        return drawing.frames.tobytes()

    before = picture()
    again = source.clip(20_000)
    look = of_set(20_000).look
    assert look.layout is not None and np.array_equal(again.clip.frames, clip.frames)
    side = np.array([-np.sin(look.layout.heading_rad), np.cos(look.layout.heading_rad)])
    for thing in source.stage._drawn[-1 - look.num_clutter : -1]:
        assert 0.099 < abs((thing.pose.p[:2] - look.layout.cube_m) @ side) < 0.161
    assert picture() == before
