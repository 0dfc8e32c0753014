"""An environment of Gymnasium by settings: its actions, pictures, state, success and limit, and what is refused."""

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from drawn_pendulum import SETTINGS
from gymnasium import spaces

from examples import fetch_controller, push_t_controller
from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.core.types import Environment
from wm_nodes.environments.batch import EnvironmentBatch
from wm_nodes.environments.registry import configured_spec, make_environment
from wm_nodes.policy_rl.advantages import gae
from wm_nodes.policy_rl.factories import untrained_policy
from wm_nodes.policy_rl.image_policy import PolicyOutput
from wm_nodes.policy_rl.rollouts import collect_rollout, rollout_statistics
from wm_nodes.policy_rl.validation.evaluation import evaluate
from wm_nodes.reward.rule import RuleReward


class Seesaw(gymnasium.Env[dict[str, Any], np.ndarray]):
    """Shows its own pictures and says what it was told; `terminated` is a fall, info["level"] the success."""

    def __init__(self) -> None:
        picture, angle = spaces.Box(0, 255, (8, 12, 3), np.uint8), spaces.Box(-1.0, 1.0, (1,))
        self.observation_space = spaces.Dict({"camera": picture, "angle": angle, "goal": spaces.Box(-1.0, 1.0, (2,))})
        self.action_space = spaces.Box(np.array([0.0, -2.0]), np.array([4.0, 2.0]), dtype=np.float64)

    def reset(self, **_: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        return self._shown(0.0), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.taken = action
        info = {"level": action[1] > 1, "height": action[0]}
        return self._shown(action[0] / 4), 0.0, bool(action[1] < -1), False, info

    def _shown(self, angle: float) -> dict[str, Any]:
        camera = np.full((8, 12, 3), 200, np.uint8)
        return {"camera": camera, "angle": np.array([angle], np.float32), "goal": np.float32([0.5, -0.5])}


gymnasium.register("seesaw-v0", entry_point=Seesaw)
SEESAW = {
    "task": "", "environment.factory": "gymnasium", "gymnasium.env_id": "seesaw-v0", "gymnasium.pixels": "camera",
    "gymnasium.state": ["angle", "goal"], "gymnasium.image_size": [4, 6], "gymnasium.success": "level",
    "gymnasium.kwargs": {"max_episode_steps": 5}, "gymnasium.instruction": "keep it level",
}


VIEW = {"top": {"lookat_m": [0, 0, 0], "distance_m": 1, "azimuth_deg": 0, "elevation_deg": -90}}


def made(settings: dict[str, Any], num_envs: int = 2, preset: str = "smoke") -> Environment:
    config = load_config(preset, settings)
    return make_environment(config, config.environment.factory, num_envs=num_envs, seed=0)


def test_the_spec_names_what_the_settings_choose() -> None:
    spec = configured_spec(load_config("smoke", SEESAW), 3)
    assert (spec.env_id, spec.instruction, spec.num_envs) == ("gymnasium/seesaw-v0", "keep it level", 3)
    assert (spec.height, spec.width, spec.cameras, spec.max_episode_steps) == (4, 6, ("camera",), 5)
    assert spec.state_names == ("angle.0", "goal.0", "goal.1") and spec.measured == (0, 1, 2)
    assert spec.action_scale == (2.0, 2.0)


def test_actions_are_scaled_to_its_box_and_pictures_to_the_size() -> None:
    environment = made(SEESAW)
    shown = environment.reset()
    assert shown.image.shape == (2, 4, 6, 3) and (shown.image == 200).all()
    result = environment.step(np.array([[1, 0], [-1, 0.5]], np.float32))
    np.testing.assert_allclose(result.observation.state, [[1, 0.5, -0.5], [0, 0.5, -0.5]])


def test_success_is_what_info_says_and_a_fall_has_failed_for_good() -> None:
    environment = made(SEESAW, num_envs=3)
    environment.reset()
    result = environment.step(np.array([[0, 0.9], [0, -0.9], [0, 0]], np.float32))
    assert result.success.tolist() == [True, False, False] and result.ended.tolist() == [True, True, False]
    assert result.terminated.tolist() == [True, True, False] and result.truncated.tolist() == [False, True, False]
    assert result.success_probability.tolist() == [1.0, 0.0, 0.0]


class Falling:
    """A policy of one action: the seesaw falls, in its first step."""

    def act(self, images: Any, states: Any, noise: Any = None) -> PolicyOutput:
        actions = np.tile(np.float32([0, -0.9]), (len(states), 1))
        return PolicyOutput(actions, np.zeros(len(states), np.float32), np.full(len(states), 0.7, np.float32))


def test_no_success_is_counted_after_a_fall_and_no_value_follows_it() -> None:
    environment, policy = made(SEESAW), Falling()
    played = evaluate(policy, environment, 3, 1, deterministic=True)  # type: ignore[arg-type]
    assert not played.success.any() and played.length.tolist() == [1, 1, 1]
    rollout = collect_rollout(environment, policy, RuleReward(), 2, 0, 1, 1)  # type: ignore[arg-type]
    told = rollout_statistics(rollout)
    assert (told.episodes, told.successes) == (2, 0)
    columns = (torch.from_numpy(c[:1]) for c in (
        rollout.rewards_TN, rollout.values_TN, rollout.values_TN, rollout.terminated_TN, rollout.truncated_TN,
        rollout.valid_TN,
    ))
    advantages, returns = gae(*columns, gamma=0.9, lambda_=0.9)
    np.testing.assert_allclose(advantages, [[-0.7, -0.7]])  # where an episode cut by time has -0.7 + 0.9 * 0.7
    np.testing.assert_allclose(returns, [[0, 0]], atol=1e-7)


def test_numbers_of_info_are_its_ground_truth_and_an_evaluation_gives_the_largest_of_each_episode() -> None:
    environment = made({**SEESAW, "gymnasium.measures": ["height"]})
    assert environment.spec.ground_truth_names == ("height",)
    environment.reset()
    assert isinstance(environment, EnvironmentBatch) and np.isnan(environment.ground_truth).all()  # until a step says
    result = environment.step(np.array([[0.5, 0], [-1, 0]], np.float32))
    np.testing.assert_allclose(result.ground_truth, [[3.0], [0.0]])
    policy = untrained_policy(load_config("smoke", SEESAW))
    with torch.no_grad():
        played = evaluate(policy, environment, 3, 1, deterministic=False)
    assert played.largest.shape == (3, 1) and (np.ptp(played.largest) > 0) and (played.largest >= 0).all()


def test_a_seed_decides_an_episode_in_whichever_copy() -> None:
    environment = made(SETTINGS)
    shown = environment.reset(seeds=np.array([7, 7], np.uint64))
    np.testing.assert_array_equal(shown.state[0], shown.state[1])
    assert (environment.reset().state[0] != shown.state[0]).any()


def test_an_action_of_1_takes_a_share_of_its_range_and_single_values_are_a_state() -> None:
    settings = {**SEESAW, "gymnasium.action_scale": 0.5, "gymnasium.state": ["goal.1", "angle"]}
    spec = configured_spec(load_config("smoke", settings))
    assert (spec.action_scale, spec.state_names) == ((1.0, 1.0), ("goal.1", "angle.0"))
    environment = made(settings)
    environment.reset()
    result = environment.step(np.array([[1, 0], [-1, 0]], np.float32))
    np.testing.assert_allclose(result.observation.state, [[-0.5, 0.75], [-0.5, 0.25]])


def fetch(preset: str) -> Iterator[Environment]:
    if find_spec("gymnasium_robotics") is None:  # not imported here: MuJoCo chooses how to draw when it is imported
        pytest.skip(f"{preset} needs requirements/gym.txt")
    environment = made({}, preset=preset)
    yield environment
    environment.close()


@pytest.fixture
def fetch_reach() -> Iterator[Environment]:
    yield from fetch("fetch_reach")


@pytest.fixture
def fetch_push() -> Iterator[Environment]:
    yield from fetch("fetch_push")


def test_fetch_reach_shows_its_goal_in_both_cameras_and_says_success(fetch_reach: Environment) -> None:
    policy = fetch_controller.reach(load_config("fetch_reach"))
    shown = fetch_reach.reset(seeds=np.array([3, 4], np.uint64))
    assert shown.image.shape == (2, 64, 128, 3) and shown.state.shape == (2, 3)
    red = (shown.image[..., 0] > 90) & (shown.image[..., 1:] < 60).all(-1)
    assert (red.reshape(2, 64, 2, 64).sum((1, 3)) > 3).all()
    success = np.zeros(2, bool)
    for _ in range(fetch_reach.spec.max_episode_steps):
        result = fetch_reach.step(policy.act(shown.image, shown.state).actions)
        shown, success = result.observation, success | result.terminated
    assert success.all() and not result.valid.any()


def test_the_controller_of_fetch_push_pushes_the_block_onto_the_spot(fetch_push: Environment) -> None:
    policy = fetch_controller.push(load_config("fetch_push"))
    shown = fetch_push.reset(seeds=np.array([4, 5], np.uint64))
    places = policy.encoder(torch.from_numpy(shown.image))
    assert (torch.linalg.norm(places[:, :2] - places[:, 2:], dim=1) > 0.05).all()
    success = np.zeros(2, bool)
    for _ in range(fetch_push.spec.max_episode_steps):
        result = fetch_push.step(policy.act(shown.image, shown.state).actions)
        shown, success = result.observation, success | result.terminated
    assert success.all()


def test_an_action_of_1_moves_fetch_by_about_a_centimetre(fetch_reach: Environment) -> None:
    before = fetch_reach.reset().state
    moved = [fetch_reach.step(np.tile(np.float32([1, 0, 0, 0]), (2, 1))).observation.state for _ in range(4)][-1]
    assert 0.03 < (moved - before)[:, 0].mean() < 0.06


def test_push_t_shows_its_two_shapes_and_an_action_says_where_the_pusher_goes() -> None:
    pytest.importorskip("gym_pusht", reason="PushT needs what requirements/gym.txt says")
    environment = made({}, preset="push_t")
    shown = environment.reset(seeds=np.array([1, 2], np.uint64))
    green = (shown.image == np.uint8([144, 238, 144])).all(-1)  # pygame's LightGreen
    assert (green.sum((1, 2)) > 20).all() and (shown.image[0] != shown.image[1]).any()
    for _ in range(20):
        result = environment.step(np.float32([[-0.9, -0.9], [0.9, -0.9]]))
    np.testing.assert_allclose(result.observation.state, [[25.6, 25.6], [486.4, 25.6]], atol=8)
    assert not result.terminated.any() and environment.spec.max_episode_steps == 300


def test_the_controller_of_push_t_covers_the_spot() -> None:
    pytest.importorskip("gym_pusht", reason="PushT needs what requirements/gym.txt says")
    environment, policy = made({}, preset="push_t"), push_t_controller.push(load_config("push_t"))
    played = evaluate(policy, environment, 2, 1_500_000)
    assert (played.largest[:, 0] > 0.7).all() and (played.largest[:, 0] > 0.95).tolist() == played.success.tolist()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gymnasium.env_id": "absent-v0"}, "gymnasium.env_id 'absent-v0' .*package:name"),
        ({"gymnasium.env_id": "CartPole-v1"}, r"takes actions of Discrete\(2\)"),
        ({"gymnasium.kwargs": {}}, "sets no limit to an episode; give gymnasium.kwargs max_episode_steps"),
        ({"gymnasium.state": ["speed"]}, r"no 'speed'; .* may name \['angle', 'camera', 'goal'\]"),
        ({"gymnasium.pixels": "angle"}, r"pixels 'angle' gives float32 \(1,\), not uint8 \(H, W, 3\)"),
        ({"gymnasium.state": ["goal.2"]}, r"gymnasium.state names goal.2, and goal has 2 values"),
        ({"gymnasium.pixels": "cameras"}, "pixels is cameras, and cameras names none"),
        ({"gymnasium.pixels": "cameras", "gymnasium.cameras": VIEW}, "needs an environment of MuJoCo, not Seesaw"),
        ({"gymnasium.action_scale": 2.0}, "gymnasium.action_scale: .* less than or equal to 1"),
        ({"gymnasium.measures": ["depth"]}, r"measures names \['depth'\], and info has \['height', 'level'\]"),
        ({"environment.factory": "mujoco"}, "no environment 'mujoco'; choose one of maniskill, gymnasium"),
    ],
)
def test_what_does_not_fit_is_refused_by_value_and_remedy(changes: dict[str, Any], words: str) -> None:
    def use() -> None:
        environment = made({**SEESAW, **changes})
        environment.reset()
        environment.step(np.zeros((2, 2), np.float32))

    with pytest.raises(ValueError, match=words):
        use()


def test_a_factory_of_a_wrong_form_is_refused_with_the_settings() -> None:
    with pytest.raises(ConfigError, match=r"reward\.factory: a factory is written module:callable .got 'mine'"):
        load_config("smoke", {"reward.factory": "mine"})
