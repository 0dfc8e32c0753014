"""Planned and scripted trajectories of the tasks with pose actions: kinds, repetition, labels, a planner that fails."""

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from own_packages import own_package

from wm_nodes.config.load import load_config
from wm_nodes.config.tasks import VARIABLE, get_task
from wm_nodes.core.types import Episode, FloatArray
from wm_nodes.environments.maniskill import pose_behaviours
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import planned_episode, planned_or_scripted_episode, scripted_episode
from wm_nodes.environments.maniskill.objects import GRASPED, OBJECT, OBJECT_START
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner
from wm_nodes.environments.maniskill.pose_behaviours import BEHAVIOURS, PLANNED, vary
from wm_nodes.environments.maniskill.pose_scripts import CLOSED, OPEN, waypoint

TASKS = ("push", "pull", "pick_place", "move_to_aim", "reach_object")
FAR = '''
"""Pick up the object somewhere else: where the robot cannot reach."""
from dataclasses import replace

from wm_nodes.environments.maniskill.pose_behaviours import scripted
from wm_nodes.environments.maniskill.pose_scripts import waypoint
from wm_nodes.environments.maniskill.tasks import pick_place


def waypoints(truth):
    return [waypoint((0.0, 0.1), 0.1, 0.0, 1.0), waypoint((2.0, 0.0), 0.1, 0.0, 1.0)]


TASK = replace(pick_place.TASK, simulator=replace(
    pick_place.TASK.simulator, waypoints=waypoints, script=scripted(waypoints, speed=0.8)
))
'''
START = waypoint((0.0, 0.0), 0.17, 0.0, OPEN)
PICK = [
    waypoint((0.05, 0.1), 0.11, 0.4, OPEN), waypoint((0.05, 0.1), 0.02, 0.4, OPEN),
    waypoint((0.05, 0.1), 0.02, 0.4, CLOSED), waypoint((0.05, 0.1), 0.11, 0.4, CLOSED),
    waypoint((-0.05, -0.1), 0.11, 0.4, CLOSED), waypoint((-0.05, -0.1), 0.04, 0.4, CLOSED),
    waypoint((-0.05, -0.1), 0.04, 0.4, OPEN), waypoint((-0.05, -0.1), 0.11, 0.4, OPEN),
]


@cache
def blind(task: str) -> tuple[ManiSkillEnvironment, DemonstrationPlanner]:
    """A simulator without pictures, and its planner."""
    env = ManiSkillEnvironment(
        task, load_config("cpu", {"task": task}).simulation, pictures=False, end_on_success=False
    )
    return env, DemonstrationPlanner(env)


@pytest.fixture(scope="module", autouse=True)
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with own_package(tmp_path_factory.mktemp("packages"), "far_tasks", VARIABLE, pick_far=FAR):
        yield
    get_task.cache_clear()
    blind.cache_clear()


def varied(behaviour: str, seed: int = 0) -> list[FloatArray]:
    return vary(behaviour, PICK, START, np.random.default_rng(seed))


def same(first: Episode, second: Episode) -> bool:
    pairs = ((getattr(first, name), getattr(second, name)) for name in ("states", "actions", "ground_truth", "success"))
    return all(np.array_equal(one, other) for one, other in pairs)


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
def test_a_variation_repeats_to_the_bit_and_leaves_the_essential_waypoints_alone(behaviour: str) -> None:
    before = np.stack(PICK)
    once, again = varied(behaviour, 3), varied(behaviour, 3)
    np.testing.assert_array_equal(np.stack(once), np.stack(again))
    np.testing.assert_array_equal(np.stack(PICK), before)
    unchanged = len(once) == len(PICK) and np.array_equal(np.stack(once), before)
    assert unchanged == (behaviour in ("expert", "noisy"))
    assert all(point.dtype == np.float32 and point.shape == (7,) for point in once)


def test_an_unknown_behaviour_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'fly'.*expert.*no_grasp"):
        varied("fly")


def test_a_detour_adds_one_or_two_waypoints_near_those_in_free_space() -> None:
    added = set[int]()
    for seed in range(20):
        points = varied("detour", seed)
        extra = [p for p in points if not any(np.array_equal(p, essential) for essential in PICK)]
        added.add(len(extra))
        for point in extra:
            near = min(PICK, key=lambda p: float(np.abs(p[:3] - point[:3]).max()))
            assert np.abs(near[:2] - point[:2]).max() <= 0.08 + 1e-6 and point[2] >= 0.07 - 1e-6
        assert [p.tolist() for p in points if not any(p is e for e in extra)] == [p.tolist() for p in PICK]
    assert added == {1, 2}


def test_interpolation_cuts_each_way_into_two_to_four_pieces_on_the_straight_line() -> None:
    counts = set[int]()
    for seed in range(20):
        points = varied("interpolated", seed)
        ends = [next(i for i, p in enumerate(points) if np.array_equal(p, essential)) for essential in PICK]
        assert ends == sorted(ends) and ends[2] == ends[1] + 1 and ends[6] == ends[5] + 1, "a gripper needs no pieces"
        counts |= {ends[0] + 1, ends[1] - ends[0], ends[4] - ends[3]}
        for point in points[ends[3] + 1 : ends[4]]:
            share = (point[0] - PICK[3][0]) / (PICK[4][0] - PICK[3][0])
            np.testing.assert_allclose(point[:3], PICK[3][:3] + share * (PICK[4][:3] - PICK[3][:3]), atol=1e-6)
    assert counts == {2, 3, 4}


def test_jitter_displaces_by_a_centimetre_and_five_degrees_and_never_below_the_fingers() -> None:
    offsets = np.stack([np.stack(varied("jitter", seed)) - np.stack(PICK) for seed in range(300)])
    np.testing.assert_array_equal(offsets[:, 1, :6], offsets[:, 2, :6], "the tool moved while the gripper closed")
    high = offsets[:, [0, 3, 4, 7]]
    np.testing.assert_allclose(high[..., :3].std((0, 1)), 0.01, rtol=0.1)
    np.testing.assert_allclose(high[..., 5].std(), np.deg2rad(5), rtol=0.1)
    assert min(point[2] for seed in range(300) for point in varied("jitter", seed)) >= 0.012 - 1e-6


def test_every_way_of_missing_is_what_its_name_says() -> None:
    for seed in range(20):
        near = np.stack(varied("near_miss", seed)) - np.stack(PICK)
        shift = np.linalg.norm(near[:, :2], axis=1)
        assert 0.015 <= shift[-1] <= 0.06 and min(shift[0], abs(shift[0] - shift[-1])) < 1e-6
        assert (np.stack(varied("over", seed)) - np.stack(PICK))[:, 2].min() > 0.014
        assert len(varied("short", seed)) <= len(PICK)
        assert not np.array_equal(varied("short", seed)[-1], PICK[-1])
        assert {point[6] for point in varied("no_grasp", seed)} == {OPEN}
        grips = [point[6] for point in varied("early_release", seed)]
        opened = grips.index(OPEN, 3)
        assert grips[2] == CLOSED and set(grips[opened:]) == {OPEN}
        dropped = varied("early_release", seed)[opened]
        assert np.linalg.norm(dropped[:2] - PICK[-1][:2]) > 1e-3 or dropped[2] > PICK[5][2] + 1e-3


@pytest.mark.rendering
@pytest.mark.parametrize("task", TASKS)
def test_the_optimal_plan_of_each_task_succeeds_in_the_simulator(task: str) -> None:
    env, planner = blind(task)
    episode = planned_episode(env, planner, 1, 7)
    assert episode.success[-1] and not episode.success[0] and episode.behaviour == "expert"
    assert episode.task == task and episode.instruction == env.instructions[0] != env.spec.instruction
    assert episode.extra == {"scene": env.shown_scenes[0].name}
    assert np.abs(episode.actions).max() <= 1
    if task == "pick_place":
        assert episode.ground_truth[:, GRASPED].any() and not episode.ground_truth[-1, GRASPED]


@pytest.mark.rendering
def test_kinds_differ_and_repeat_to_the_bit() -> None:
    env, planner = blind("push")
    episodes = {kind: planned_episode(env, planner, 2, 0, kind) for kind in PLANNED}
    for kind, episode in episodes.items():
        assert episode.behaviour == kind and not any(
            np.array_equal(episode.actions, other.actions) for name, other in episodes.items() if name != kind
        )
    assert same(episodes["detour"], planned_episode(env, planner, 2, 0, "detour"))
    assert same(episodes["jitter"], planned_episode(env, planner, 2, 0, "jitter"))
    slow, fast = (np.abs(episodes[kind].actions[:, :3]).max(1) for kind in ("interpolated", "expert"))
    assert (slow > 0.02).sum() > (fast > 0.02).sum(), "pieces that each start and end at rest take longer"


@pytest.mark.rendering
def test_a_jitter_that_misses_is_kept_and_labelled_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    env, planner = blind("pick_place")
    monkeypatch.setattr(pose_behaviours, "JITTER_M", 0.06)
    episode = planned_or_scripted_episode(env, planner, "jitter", 1, 4)
    assert episode.behaviour == "jitter" and episode.seed == 1 and episode.episode_id == 4
    assert not episode.success.any() and episode.rewards.sum() == 0 and episode.truncated


@pytest.mark.rendering
def test_a_hand_that_stays_open_and_an_early_release_fail_and_are_labelled_so() -> None:
    env, _ = blind("pick_place")
    empty = scripted_episode(env, "no_grasp", 1, 0)
    assert not empty.success.any() and not empty.ground_truth[:, GRASPED].any() and empty.behaviour == "no_grasp"
    dropped = scripted_episode(env, "early_release", 1, 0)
    assert not dropped.success.any() and dropped.ground_truth[:, GRASPED].any()
    assert np.linalg.norm(dropped.ground_truth[-1, OBJECT][:2] - dropped.ground_truth[0, OBJECT_START]) > 0.001


@pytest.mark.rendering
def test_without_a_plan_one_line_says_where_and_the_script_acts(capsys: pytest.CaptureFixture[str]) -> None:
    env, planner = blind("pick_far")
    episode = planned_or_scripted_episode(env, planner, "detour", 5, 9)
    scene, (line,) = env.shown_scenes[0].name, capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: seed 5, scene {scene}, task pick_far, detour: no path to waypoint ")
    assert " of 3, [2.0, 0.0, 0.1]: " in line or " of 4, [2.0, 0.0, 0.1]: " in line
    assert episode.behaviour == "detour" and "no path to waypoint" in episode.extra["planner"]
    assert episode.extra["scene"] == scene and same(episode, scripted_episode(env, "detour", 5, 9))
