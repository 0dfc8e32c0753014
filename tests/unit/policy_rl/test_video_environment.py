"""A video model's folder as the environment of loop 1: what is refused, and what a training makes of it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from model_folders import make_model_folder, make_stepped_folder, write_starts

from wm_nodes.config.load import load_config
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.policy_rl.factories import (
    load_steppable,
    make_endogenous_reward,
    make_policy,
    make_video_environment,
)
from wm_nodes.policy_rl.train import train_policy


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_stepped_folder(tmp_path_factory.mktemp("stepped") / "video_model")


def test_a_policy_learns_from_the_done_signal_and_equal_seeds_give_equal_weights(folder: Path, tmp_path: Path) -> None:
    config, model = load_config("smoke"), make_model_folder(tmp_path / "model")
    starts = write_starts(tmp_path / "starts.safetensors")
    found = []
    for _ in range(2):
        policy, reward = make_policy(config, model), make_endogenous_reward(config, model)
        first = [parameter.clone() for parameter in policy.parameters()]
        env = make_video_environment(config, folder, starts, num_envs=config.ppo.num_envs, seed=config.seed)
        rollouts = [rollout for rollout, _ in train_policy(policy, env, reward, config)]
        paid, ended = rollouts[0].rewards_TN > 0, rollouts[0].terminated_TN
        assert ended.any() and not ended.all()
        np.testing.assert_array_equal(paid, ended)
        assert any(not torch.equal(old, new) for old, new in zip(first, policy.parameters(), strict=True))
        found.append(torch.cat([parameter.detach().flatten() for parameter in policy.parameters()]))
    assert torch.equal(*found)


def test_it_has_the_cameras_of_the_scene(folder: Path, tmp_path: Path) -> None:
    config, starts = load_config("smoke"), write_starts(tmp_path / "starts.safetensors")
    env = make_video_environment(config, folder, starts, num_envs=2, seed=0)
    assert [camera.name for camera in env.cameras] == list(config.simulation.cameras)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"reward.dense_weight": 0.5}, r"reward\.dense_weight is 0\.5, and a video model gives no goals; set it to 0"),
        ({"reward.uncertainty_limit": 0.1}, r"reward\.uncertainty_limit is 0\.1, and a video model gives no unc"),
        ({"task": "reach"}, "trained for the task push_cube, not for reach"),
    ],
)
def test_what_it_cannot_give_is_refused(folder: Path, setting: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_steppable(load_config("smoke", setting), folder)


def test_a_folder_without_a_success_reader_is_refused(folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "success.json").unlink()
    with pytest.raises(ModelFolderError, match=r"holds no success\.json; name the folder of a trained success reader"):
        load_steppable(load_config("smoke"), copy)
