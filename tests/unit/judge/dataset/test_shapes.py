"""Other shapes than the cube, and the set that judges are compared on."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from wm_nodes.config.load import load_config
from wm_nodes.judge.dataset.build import (
    BENCHMARK,
    HELD_OUT,
    STEADY,
    LabelledClipSource,
    SetPlan,
    draw_origin,
    instruction_of,
)
from wm_nodes.judge.dataset.edits.clips import OBJECT

pytestmark = pytest.mark.rendering
CONFIG = load_config("cpu").simulation


@pytest.fixture(scope="module")
def source() -> Iterator[LabelledClipSource]:
    made = LabelledClipSource("push_cube", CONFIG, ("slab", "post"))
    yield made
    made.close()


def test_shapes_are_rare_held_out_and_change_nothing_else(source: LabelledClipSource) -> None:
    shapes: Counter[str] = Counter()
    for seed in range(600):
        origin, without = source.origin(seed), draw_origin("push_cube", seed)
        shape, _, colour = origin.object_id.partition("/")
        assert replace(origin, object_id=f"cube/{colour}") == without
        if origin.behaviour in STEADY:
            shapes[shape] += 1
        else:
            assert shape == "cube", "a tool that strays would go through what the cube leaves free"
        if shape != "cube":
            assert BENCHMARK.held_out.held_out(origin) is not None and BENCHMARK.held_out.part(origin) == "test"
    for shape in ("post", "slab"):
        assert shapes[shape] / shapes.total() == pytest.approx(0.12, abs=0.04)


def test_a_post_stands_on_the_table_is_taller_and_is_named(source: LabelledClipSource) -> None:
    seed = next(
        seed for seed in range(300) if (o := source.origin(seed)).object_id.startswith("post")
        and o.behaviour == "expert" and o.camera == "near_side"
    )
    found = source.clip(seed)
    states = found.clip.states
    assert np.abs(states.bottom_m).max() < 3e-3
    assert states.half_sizes_m[0].tolist() == pytest.approx([0.02, 0.02, 0.034])
    rows, columns = np.nonzero(found.clip.masks[0] == OBJECT)
    assert np.ptp(rows) > 1.15 * np.ptp(columns)
    assert " post " in found.clip.instruction and found.clip.instruction == instruction_of(found.clip.origin)
    assert found.labels.tc_level == 4 and "geometry" in found.labels.components


def test_the_benchmark_is_of_seeds_and_shapes_of_its_own() -> None:
    assert set(HELD_OUT.objects) < set(BENCHMARK.held_out.objects) and "slab/green" in BENCHMARK.held_out.objects
    assert SetPlan().held_out == HELD_OUT
    assert {BENCHMARK.part("pull_cube", seed) for seed in BENCHMARK.seeds("pull_cube")} == {"test"}
    assert {BENCHMARK.part("push_cube", seed) for seed in BENCHMARK.seeds("push_cube")} >= {"test", "train"}
    with pytest.raises(ValueError, match=r"unknown shapes \['ball'\]"):
        SetPlan(shapes=("ball",))
