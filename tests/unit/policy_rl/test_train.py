"""The loop of policy RL on one screen: what it does, update by update, and that it fits a screen."""

from pathlib import Path

import numpy as np
import pytest
import torch
from graph import toy

from wm_nodes.config.load import load_config
from wm_nodes.policy_rl import train
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.rollouts import collect_rollout
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.reward import RuleReward


def test_each_update_is_a_rollout_of_the_newest_version_then_ppo() -> None:
    config = load_config("smoke", {"ppo.num_envs": 4, "ppo.updates": 3})
    policy, same = toy.make_policy(config), toy.make_policy(config)
    found = list(train_policy(policy, toy.ReachToy(4, seed=0), RuleReward(), config))
    assert [rollout.policy_version for rollout, _ in found] == [1, 2, 3]
    learner, environment = PpoLearner(same, config.ppo, seed=config.seed), toy.ReachToy(4, seed=0)
    for version, (rollout, metrics) in enumerate(found, 1):
        again = collect_rollout(environment, same, RuleReward(), config.ppo.num_steps, config.seed, version)
        np.testing.assert_array_equal(rollout.actions_TN, again.actions_TN)
        assert learner.update(again) == metrics
    for name, weight in policy.state_dict().items():
        assert torch.equal(weight, same.state_dict()[name])


def test_a_rollout_has_the_same_number_of_steps_in_fewer_environments() -> None:
    config = load_config("smoke", {"ppo.num_envs": 8, "ppo.updates": 1})
    ((rollout, _),) = train_policy(toy.make_policy(config), toy.ReachToy(2, seed=0), RuleReward(), config)
    assert rollout.valid_TN.shape == (4 * config.ppo.num_steps, 2)


def test_the_command_trains_and_names_a_device_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    train.main(["--task", "reach", "--updates", "1", "--device", "cpu"])
    told = capsys.readouterr().out
    assert told.startswith("version 1: imagined success ")
    assert told.splitlines()[-1] == (
        "acceptance of the world model: passed on 150 held-out episodes when it was made; its done signal at "
        "reward.success_threshold 0.4 and the policy in it not judged, without a simulator"
    )
    with pytest.raises(SystemExit):
        train.main(["--device", "cuda:99"])
    assert "error: device is cuda:99, but " in capsys.readouterr().err


def test_the_loop_fits_one_screen() -> None:
    assert len(Path(str(train.__file__)).read_text().splitlines()) <= 60
