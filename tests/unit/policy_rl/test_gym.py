"""The world model as Gymnasium environments: Gymnasium's own check, and its layout of automatic resets."""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, VectorEnv

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.environments.spaces import observation_space
from wm_nodes.policy_rl.factories import models_of
from wm_nodes.policy_rl.gym import ID, ModelObservation
from wm_nodes.reward import RewardInput, RewardResult, RuleReward
from wm_nodes.reward.base import assemble

N, LIMIT = 3, 3
SHORT = {"simulation.max_episode_steps": LIMIT}
AT_ONCE = {"reward.success_threshold": 0.0}
"""Every done signal counts as success."""


def made(num_envs: int = N, **arguments: Any) -> VectorEnv:  # type: ignore[type-arg]
    return gymnasium.make_vec(ID, num_envs, **{"task": "push_cube", "settings": SHORT, **arguments})


@pytest.fixture(scope="module")
def envs() -> Iterator[VectorEnv]:  # type: ignore[type-arg]
    environment = made()
    yield environment
    environment.close()


def actions(step: int, num_envs: int = N) -> np.ndarray:
    return numpy_stream(step, "actions").uniform(-1, 1, (num_envs, 3)).astype(np.float32)


def layout(infos: dict[str, Any]) -> dict[str, Any]:
    """The names in infos, and the masks."""
    return {
        key: layout(value) if isinstance(value, dict) else value.tolist() if key.startswith("_") else None
        for key, value in infos.items()
    }


class Unpaid(RuleReward):
    def evaluate(self, step: RewardInput) -> RewardResult:
        nothing = np.zeros(len(step.images), np.float32)
        return assemble(nothing, nothing, step, nothing.astype(np.uint8), {"nobody pays": nothing == 0}, {})


def unpaid(config: RunConfig) -> Unpaid:
    return Unpaid()


def test_gymnasium_finds_nothing_to_complain_about_in_a_single_one() -> None:
    environment = gymnasium.make(ID, task="push_cube", render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(environment.unwrapped)
    environment.reset(seed=1)
    assert environment.render().shape == (64, 128, 3)
    environment.close()


def test_observations_fit_their_space_and_a_seed_decides_where_episodes_begin(envs: VectorEnv) -> None:  # type: ignore[type-arg]
    first, again, other = (envs.reset(seed=seed)[0] for seed in (1, 1, 2))
    assert envs.observation_space.contains(first) and set(first) == {"image", "state"}
    np.testing.assert_array_equal(first["image"], again["image"])
    assert (first["image"] != other["image"]).any()


def test_a_step_that_ends_an_episode_shows_the_next_one_and_keeps_the_last_observation(envs: VectorEnv) -> None:  # type: ignore[type-arg]
    disabled = made(autoreset_mode="Disabled")
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert disabled.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    for environment in (envs, disabled):
        environment.reset(seed=7)
        steps = [environment.step(actions(step)) for step in range(LIMIT)]
        assert [step[3].all() for step in steps] == [False, False, True]
    last = steps[-1][0]
    envs.reset(seed=7)
    *_, (shown, _, _, _, infos) = (envs.step(actions(step)) for step in range(LIMIT))
    assert infos["_final_obs"].all() and infos["_final_info"].all() and "is_success" not in infos
    for i in range(N):
        np.testing.assert_array_equal(infos["final_obs"][i]["image"], last["image"][i])
        np.testing.assert_array_equal(infos["final_obs"][i]["state"], last["state"][i])
    assert (shown["image"] != last["image"]).any()
    assert envs.step(actions(9))[4]["_is_success"].all()


def test_infos_are_laid_out_as_gymnasium_does_it_for_single_environments(envs: VectorEnv) -> None:  # type: ignore[type-arg]
    singles = made(vectorization_mode="sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP})
    for environment in (envs, singles):
        environment.reset(seed=3)
    for step in range(LIMIT):
        ours, theirs = (layout(environment.step(actions(step))[4]) for environment in (envs, singles))
        assert ours == theirs and ("final_info" in ours) is (step == LIMIT - 1)


def test_without_automatic_resets_those_of_the_mask_begin_anew_and_no_other(envs: VectorEnv) -> None:  # type: ignore[type-arg]
    disabled = made(autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"environments \[0, 1, 2\] have ended"):
        disabled.step(actions(0))
    disabled.reset(seed=0)
    last = [disabled.step(actions(step)) for step in range(LIMIT)][-1][0]
    mask = np.array([True, False, True])
    shown, _ = disabled.reset(options={"reset_mask": mask})
    assert [bool((shown["image"][i] != last["image"][i]).any()) for i in range(N)] == mask.tolist()
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"environments \[1\] have ended; reset them"):
        disabled.step(actions(0))
    disabled.reset(options={"reset_mask": ~mask})
    assert not disabled.step(actions(0))[3].any()
    with pytest.raises(ValueError, match=r"reset_mask must be a bool array of shape \(3,\), got \[1, 0, 1\]"):
        disabled.reset(options={"reset_mask": [1, 0, 1]})


def test_success_pays_once_and_ends_the_episode() -> None:
    environment = made(settings=AT_ONCE)
    environment.reset(seed=0)
    _, rewards, terminated, truncated, infos = environment.step(actions(0))
    assert rewards.tolist() == [1, 1, 1] and terminated.all() and not truncated.any()
    assert infos["final_info"]["is_success"].all() and (infos["final_info"]["success_probability"] > 0).all()


def test_a_reward_is_chosen_by_its_name_and_one_that_pays_nothing_is_refused() -> None:
    hurried = made(settings={"reward.factory": "examples.own_reward:make"})
    hurried.reset(seed=0)
    np.testing.assert_allclose(hurried.step(actions(0))[1], -0.02)
    nobody = made(settings={"reward.factory": f"{__name__}:unpaid"})
    nobody.reset(seed=0)
    with pytest.raises(ValueError, match="reward rule has none for a step: nobody pays"):
        nobody.step(actions(0))


def test_a_model_without_a_state_shows_pictures_alone() -> None:
    spec = simulation_spec("push_cube", load_config("cpu").simulation, 1)
    unbounded = replace(spec, state_low=(), state_high=())
    assert set(observation_space(replace(unbounded, state_names=(), state_units=()))) == {"image"}
    measured = observation_space(unbounded)["state"]
    assert measured.contains(np.full(3, -1e6, np.float32))


def test_a_model_whose_pictures_are_read_shows_the_places_too() -> None:
    environment = made(2, task="push")
    names = models_of(shipped_model("push"), "cpu").spec.state_names
    assert environment.reset(seed=0)[0]["state"].shape == (2, len(names)) and "object_x" in names
    environment.close()


def test_latents_and_positions_are_those_of_the_picture_and_an_episode_s_last_ones_too() -> None:
    environment = made(observations=("image", "positions", "latents"))
    shown, _ = environment.reset(seed=4)
    assert environment.observation_space.contains(shown) and set(shown) == {"image", "positions", "latents"}
    tokenizer = models_of(shipped_model("push_cube")).tokenizer
    for _ in range(LIMIT):
        latents = tokenizer.encode(shown["image"])
        np.testing.assert_allclose(shown["latents"], latents.flatten(1), atol=1e-4)
        np.testing.assert_allclose(shown["positions"], tokenizer.read_state_normalised(latents), atol=0.03)
        shown, *_, infos = environment.step(actions(0))
    last = infos["final_obs"][1]
    np.testing.assert_allclose(last["latents"], tokenizer.encode(last["image"][None]).flatten(), atol=1e-4)


def test_a_real_environment_is_observed_as_the_model_s() -> None:
    camera = spaces.Box(0, 255, (64, 128, 3), np.uint8)

    class Still(gymnasium.Env[dict[str, Any], np.ndarray]):
        observation_space = spaces.Dict({"image": camera, "state": spaces.Box(-1, 1, (3,))})
        action_space = spaces.Box(-1, 1, (3,))

        def reset(self, **_: Any) -> tuple[dict[str, Any], dict[str, Any]]:
            return {"image": camera.low + np.uint8(9), "state": np.float32([0.1, 0.2, 0.3])}, {}

    seen = ModelObservation(Still(), ("latents", "state"), task="push_cube")
    shown, _ = seen.reset()
    assert seen.observation_space.contains(shown) and set(shown) == {"latents", "state"}
    latents = models_of(shipped_model("push_cube")).tokenizer.encode(camera.low[None] + np.uint8(9))
    np.testing.assert_allclose(shown["latents"], latents.flatten(), atol=1e-4)
    with pytest.raises(ValueError, match=r"observes Discrete.*, not a Dict of image and state"):
        ModelObservation(gymnasium.make("FrozenLake-v1"), ("latents",), task="push_cube")


def test_the_task_is_that_of_the_folder() -> None:
    environment = gymnasium.make_vec(ID, 1, model_dir=shipped_model("push"))
    assert environment.single_action_space.shape == (7,)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"task": None}, "give model_dir, or the task of a shipped one"),
        ({"model_dir": "absent"}, "absent holds no manifest.json; name the folder of a trained world model"),
        ({"model_dir": shipped_model("push")}, "knows the tasks .*, not 'push_cube'; take one of these"),
        ({"task": "stack"}, "no world model is shipped for task 'stack' .*train one with"),
        ({"num_envs": 0}, "num_envs must be a whole number >= 1, got 0"),
        ({"num_envs": 2.5}, "num_envs must be a whole number >= 1, got 2.5"),
        ({"autoreset_mode": "NextStep"}, "autoreset_mode 'NextStep' is not served; take SameStep or Disabled"),
        ({"autoreset_mode": "Never"}, "autoreset_mode 'Never' is not served"),
        ({"settings": {"reward.treshold": 1}}, r"unknown setting 'reward\.treshold'"),
        ({"starts": "absent"}, "there is no starts file absent; copy the model folder again"),
        ({"observations": "latents"}, "observations 'latents': give a tuple of image, state, latents, positions"),
        ({"observations": ("latent",)}, r"observations \('latent',\): give a tuple of image, state"),
        ({"observations": ()}, r"observations \(\): give a tuple"),
    ],
)
def test_what_does_not_fit_is_refused_by_value_and_remedy(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=words) as refusal:
        gymnasium.make_vec(ID, **{"num_envs": 1, "task": "push_cube", **arguments})
    assert "\n" not in str(refusal.value)


def test_num_envs_belongs_to_make_vec() -> None:
    with pytest.raises(ValueError, match=r"for num_envs take gymnasium\.make_vec"):
        gymnasium.make(ID, task="push_cube", num_envs=3)
