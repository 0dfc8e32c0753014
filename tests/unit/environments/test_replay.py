"""Paths of recorded episodes, followed again in the simulator without pictures."""

from collections.abc import Iterator

import numpy as np
import pytest

from wm_nodes.config.load import load_config
from wm_nodes.config.tasks import truth_columns
from wm_nodes.core.types import Episode
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import scripted_episode
from wm_nodes.environments.maniskill.table_top import CUBE, TOOL
from wm_nodes.environments.replay import execute_paths

SIMULATION = load_config("cpu").simulation
STRIDE = 2


@pytest.fixture(scope="module")
def blind() -> Iterator[ManiSkillEnvironment]:
    environment = ManiSkillEnvironment("push_cube", SIMULATION, end_on_success=False, pictures=False)
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def recorded(blind: ManiSkillEnvironment) -> list[Episode]:
    """One push into the goal and one over the cube."""
    return [scripted_episode(blind, behaviour, seed, seed) for behaviour, seed in (("expert", 11), ("over", 3))]


def test_without_pictures_the_physics_is_the_same_to_the_bit(recorded: list[Episode]) -> None:
    seeing = ManiSkillEnvironment("push_cube", SIMULATION, end_on_success=False)
    episode = scripted_episode(seeing, "expert", 11, 11)
    seeing.close()
    np.testing.assert_array_equal(recorded[0].ground_truth, episode.ground_truth)
    assert not recorded[0].images.any() and episode.images.std() > 10


def test_a_recorded_path_does_again_what_it_did_and_one_that_stays_does_nothing(recorded: list[Episode]) -> None:
    truth = np.stack([episode.ground_truth[::STRIDE] for episode in recorded])
    assert [bool(episode.success[-1]) for episode in recorded] == [True, False]
    paths, ends = truth[..., TOOL], truth[:, -1, CUBE][:, :2]
    executed = execute_paths("push_cube", SIMULATION, [11, 3], paths, ends, STRIDE)
    assert executed.success.tolist() == [True, False]
    assert executed.object_error_cm.max() < 2 and executed.tool_error_cm.max() < 1
    still = execute_paths("push_cube", SIMULATION, [11], paths[:1, :1].repeat(9, 1), ends[:1], STRIDE)
    assert not still.success[0] and still.tool_error_cm[0] < 0.5
    pushed_cm = 100 * np.linalg.norm(ends[0] - truth[0, 0, CUBE][:2])
    assert still.object_error_cm[0] == pytest.approx(pushed_cm, abs=0.1)


def test_a_jump_is_not_followed(recorded: list[Episode]) -> None:
    path = recorded[1].ground_truth[None, ::STRIDE, TOOL].copy()
    path[0, 4:, 1] += 0.3
    executed = execute_paths("push_cube", SIMULATION, [3], path, np.zeros((1, 2), np.float32), STRIDE)
    assert executed.tool_error_cm[0] > 3


def test_arrays_that_do_not_belong_together_and_paths_that_are_not_finite_are_refused() -> None:
    path = np.zeros((1, 3, 3), np.float32)
    with pytest.raises(ValueError, match=r"2 seeds.*\(1, 3, 3\)"):
        execute_paths("push_cube", SIMULATION, [1, 2], path, np.zeros((1, 2), np.float32), STRIDE)
    path[0, 1, 2] = np.nan
    with pytest.raises(ValueError, match="path 0 is not finite"):
        execute_paths("push_cube", SIMULATION, [1], path, np.zeros((1, 2), np.float32), STRIDE)


def test_an_arm_that_is_commanded_by_poses_follows_the_path_with_its_gripper_as_it_was() -> None:
    simulation = load_config("cpu", {"task": "push", "simulation.scenes": "train"}).simulation
    environment = ManiSkillEnvironment("push", simulation, end_on_success=False, pictures=False)
    episode = scripted_episode(environment, "expert", 11, 11)
    environment.close()
    tool = truth_columns("push", "tool")
    path, thing = episode.ground_truth[None, ::STRIDE, tool], truth_columns("push", "object")
    executed = execute_paths("push", simulation, [11], path, episode.ground_truth[-1:, thing], STRIDE)
    assert executed.tool_error_cm[0] < 1 and executed.success.tolist() == [bool(episode.success[-1])] == [True]
