"""Where things lie at the start: feasible for every seed, for every task of the procedural scenes. No simulator."""

import numpy as np
import pytest

from wm_nodes.config.load import load_config
from wm_nodes.config.scenes import SHAPES
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.layouts import Layout, distance_to_segment, draw
from wm_nodes.environments.maniskill.pose_scripts import push_waypoints
from wm_nodes.environments.maniskill.scene_parts import CARPET_HALF_M, CONTAINER_HEIGHT_M, CONTAINER_RADIUS_M
from wm_nodes.environments.maniskill.shape import bottom_m, get_shape
from wm_nodes.environments.maniskill.shapes import bar
from wm_nodes.environments.maniskill.tasks import move_to_aim, pick_place, pull, push, reach_object

SEEDS = 400
WIDEST_M = float(np.linalg.norm(bar.HALF_M[:2]))
"""Of all objects, from the centre."""
FINGER_M = 0.012
PLACES = {task.__name__.rsplit(".", 1)[1]: task.place for task in (push, pull, pick_place, move_to_aim, reach_object)}


def layouts(task: str) -> list[Layout]:
    return [PLACES[task](numpy_stream(seed, "layout")) for seed in range(SEEDS)]


@pytest.mark.parametrize("task", PLACES)
def test_a_seed_gives_one_layout_and_nothing_touches_the_container(task: str) -> None:
    drawn = layouts(task)
    again = PLACES[task](numpy_stream(7, "layout"))
    np.testing.assert_array_equal(again.object, drawn[7].object)
    np.testing.assert_array_equal(again.container, drawn[7].container)
    gaps = [np.linalg.norm(layout.object - layout.container) for layout in drawn]
    assert min(gaps) > CONTAINER_RADIUS_M + WIDEST_M + FINGER_M
    assert np.std([layout.object for layout in drawn], 0).min() > 0.02
    assert np.ptp([layout.object_yaw for layout in drawn]) > 1.5


@pytest.mark.parametrize("task", PLACES)
def test_everything_lies_in_the_workspace(task: str) -> None:
    simulation = load_config("cpu", {"task": task}).simulation
    box = simulation.workspace_low_m, simulation.workspace_high_m
    low, high = (np.array(edge)[:2] + ROBOT_BASE[:2] for edge in box)
    for layout in layouts(task):
        for place in (layout.object, layout.container, layout.goal):
            assert (place > low).all() and (place < high).all()


@pytest.mark.parametrize(("task", "direction"), [(push, 1), (pull, -1)])
def test_the_way_of_a_push_is_free_and_the_tool_has_room_behind_the_object(task: object, direction: int) -> None:
    simulation = load_config("cpu", {"task": "push"}).simulation
    low, high = simulation.workspace_low_m[0] + ROBOT_BASE[0], simulation.workspace_high_m[0] + ROBOT_BASE[0]
    for layout in layouts("push" if direction == 1 else "pull"):
        np.testing.assert_allclose(layout.goal - layout.object, [0.1 * direction, 0])
        truth = np.zeros(19, np.float32)
        truth[0:2], truth[7:9] = layout.object, layout.goal
        way: list[FloatArray] = push_waypoints(truth, push.BEHIND_M)
        assert all(low < point[0] < high for point in way)
        clear = distance_to_segment(layout.container, way[0][:2].astype(float), layout.goal)
        assert clear > CONTAINER_RADIUS_M + WIDEST_M + FINGER_M


def test_the_object_never_starts_on_the_carpet_and_the_container_lies_beside_it() -> None:
    for layout in layouts("move_to_aim"):
        way = np.linalg.norm(layout.object - layout.goal)
        assert layout.carpet and way > CARPET_HALF_M * np.sqrt(2) + WIDEST_M - 0.003
        assert np.abs(layout.container - layout.goal).max() > CARPET_HALF_M
        assert np.linalg.norm(layout.container - layout.goal) > CONTAINER_RADIUS_M + CARPET_HALF_M


def test_a_rectangle_without_a_free_place_is_an_error_that_says_so() -> None:
    with pytest.raises(RuntimeError, match=r"draws from \(\(\(0, 0\), \(1, 1\)\),\) were all too near"):
        draw(np.random.default_rng(0), (((0, 0), (1, 1)),), lambda point: False)


def test_a_distance_is_to_the_nearest_point_of_the_way() -> None:
    start, end = np.array([0.0, 0.0]), np.array([1.0, 0.0])
    assert distance_to_segment(np.array([0.5, 0.2]), start, end) == pytest.approx(0.2)
    assert distance_to_segment(np.array([1.3, 0.4]), start, end) == pytest.approx(0.5)
    assert distance_to_segment(np.array([0.3, 0.4]), start, start) == pytest.approx(0.5)


def test_the_lowest_point_of_an_object_is_found_however_it_lies() -> None:
    upright, on_side = (1, 0, 0, 0), (np.sqrt(0.5), 0, np.sqrt(0.5), 0)  # turned by 90 degrees about y
    for shape in SHAPES:
        assert bottom_m(shape, get_shape(shape).rest_height_m, upright) == pytest.approx(0, abs=1e-9)
    assert bottom_m("cylinder", 0.05, on_side) == pytest.approx(0.05 - 0.019)
    assert bottom_m("capsule", 0.05, on_side) == pytest.approx(0.05 - 0.039)
    assert bottom_m("bar", 0.05, on_side) == pytest.approx(0.05 - bar.HALF_M[0])
    on_edge = (np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0)
    assert bottom_m("cube", 0.05, on_edge) == pytest.approx(0.05 - 0.022 * np.sqrt(2))
    assert CONTAINER_HEIGHT_M == {"plate": 0.008, "bowl": 0.028}
