"""The tasks as Gymnasium environments: Gymnasium's own check, and what an episode tells."""

import subprocess
import sys
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import wm_nodes.environments.gym
from wm_nodes.config.load import ConfigError
from wm_nodes.config.scenes import scene_of
from wm_nodes.config.tasks import get_task, simulator_part, task_names
from wm_nodes.core.seeding import numpy_stream

pytestmark = pytest.mark.rendering


@pytest.fixture(scope="module")
def env() -> Iterator[gymnasium.Env]:  # type: ignore[type-arg]
    environment = gymnasium.make("wm/push-v0", scenes="train", max_episode_steps=12, render_mode="rgb_array")
    yield environment
    environment.close()


@pytest.mark.filterwarnings("error::UserWarning")
def test_gymnasium_finds_nothing_to_complain_about(env: gymnasium.Env) -> None:  # type: ignore[type-arg]
    check_env(env.unwrapped, skip_render_check=True)


def test_an_episode_has_observation_sparse_reward_and_the_truth_by_name(env: gymnasium.Env) -> None:  # type: ignore[type-arg]
    observation, info = env.reset(seed=1)
    scene = scene_of("train", 1)
    assert scene and info["scene"] == scene.name
    assert info["instruction"] == f"push the {scene.object} away from the robot"
    assert observation["image"].shape == (64, 128, 3) and observation["state"].shape == env.action_space.shape == (7,)
    names = get_task("push").ground_truth_names
    assert tuple(info["ground_truth"]) == names and not info["success"]
    truth = np.array([info["ground_truth"][name] for name in names], np.float32)
    act = simulator_part("push").script("expert", truth, numpy_stream(1, "behaviour"), 0.1)
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated):
        truth = np.array([info["ground_truth"][name] for name in names], np.float32)
        observation, reward, terminated, truncated, info = env.step(act(truth, observation["state"]))
        rewards.append(float(reward))
    assert terminated and info["success"] and sum(rewards) == rewards[-1] == 1
    assert info["ground_truth"]["object_x"] - info["ground_truth"]["object_start_x"] >= 0.1
    np.testing.assert_array_equal(env.render(), observation["image"])


def test_an_episode_that_does_nothing_is_truncated_without_reward(env: gymnasium.Env) -> None:  # type: ignore[type-arg]
    env.reset(seed=2)
    results = [env.step(np.zeros(7, np.float32)) for _ in range(12)]
    assert [result[3] for result in results] == [False] * 11 + [True]
    assert not any(result[1] or result[2] for result in results)


def test_a_reset_without_a_seed_goes_on_from_the_seed_before(env: gymnasium.Env) -> None:  # type: ignore[type-arg]
    def drawn() -> list[str]:
        env.reset(seed=3)
        return [env.reset()[1]["scene"] for _ in range(3)]

    first = drawn()
    assert len(set(first)) > 1 and drawn() == first


def test_every_task_is_registered_and_settings_are_checked() -> None:
    assert wm_nodes.environments.gym
    registered = {name for name in gymnasium.registry if name.startswith("wm/")}
    assert registered == {f"wm/{task}-v0" for task in task_names()}
    with pytest.raises(ConfigError, match="unknown scenes 'moon'"):
        gymnasium.make("wm/push-v0", scenes="moon")
    with pytest.raises(ConfigError, match=r"unknown setting 'simulation\.color'"):
        gymnasium.make("wm/push-v0", color=1)


@pytest.mark.slow
def test_naming_the_module_is_enough_to_make_one() -> None:
    code = (
        "import gymnasium; env = gymnasium.make('wm_nodes.environments.gym:wm/reach-v0'); "
        "print(env.reset(seed=1)[1]['instruction'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "move the gripper above the blue cube\n"
