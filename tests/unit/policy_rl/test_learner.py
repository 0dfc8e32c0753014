"""A learner of another algorithm than PPO, see tests/graph/reinforce.py, takes PPO's place everywhere."""

from pathlib import Path

import torch
from graph import toy
from graph.reinforce import make_reinforce

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.policy_rl.device_rollout import DeviceCollector
from wm_nodes.policy_rl.factories import make_device_environment, make_endogenous_reward, make_policy
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.policy_rl.rollouts import collect_rollout
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.policy_rl.training_run import DroppedTransitions, PolicyTraining
from wm_nodes.reward import RuleReward


def config_of(**ppo: object) -> RunConfig:
    chosen = {"learner.factory": "graph.reinforce:make_reinforce", "ppo.num_envs": 4}
    return load_config("smoke", chosen | {f"ppo.{name}": value for name, value in ppo.items()})


def start(config: RunConfig, policy: ImagePolicy, run_dir: Path) -> PolicyTraining:
    learner = make_reinforce(policy, config)
    return PolicyTraining(policy, learner, run_dir, resume=True, keep_versions=20, metadata={})


def update(training: PolicyTraining, config: RunConfig) -> None:
    rollout = collect_rollout(
        toy.ReachToy(4, seed=0), training.policy, RuleReward(), config.ppo.num_steps, config.seed, training.version
    )
    assert training.update(rollout, DroppedTransitions(), lambda: False)["samples"] == rollout.valid_TN.sum()


def assert_equal(one: ImagePolicy, other: ImagePolicy) -> None:
    for name, tensor in one.state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name]), name


def test_it_learns_in_one_process() -> None:
    config = config_of(updates=40, num_envs=32, learning_rate=1e-2)
    rewards = [
        float(rollout.rewards_TN[rollout.valid_TN].mean())
        for rollout, _ in train_policy(toy.make_policy(config), toy.ReachToy(32, seed=0), RuleReward(), config)
    ]
    assert sum(rewards[-5:]) > 1.5 * sum(rewards[:5])


def test_a_run_that_is_resumed_from_its_checkpoint_gives_the_weights_of_one_that_was_not(tmp_path: Path) -> None:
    config, straight, first, resumed = config_of(updates=3), *(toy.make_policy(config_of()) for _ in range(3))
    assert len(list(train_policy(straight, toy.ReachToy(4, seed=0), RuleReward(), config))) == 3
    training = start(config, first, tmp_path)
    for _ in range(2):
        update(training, config)
    again = start(config, resumed, tmp_path)
    assert (again.version, again.updates) == (3, 2)
    update(again, config)
    assert_equal(resumed, straight)
    assert not torch.equal(resumed.actor.output.weight, first.actor.output.weight)


def test_it_trains_from_rollouts_that_stay_on_the_device(tmp_path: Path) -> None:
    model = shipped_model("reach")
    config = load_config("cpu", {"task": "reach", "reward.dense_weight": 1.0})
    policy = make_policy(config, model)
    environment = make_device_environment(config, model, model / STARTS, num_envs=4)
    collector = DeviceCollector(environment, policy, make_endogenous_reward(config, model))
    training, before = start(config, policy, tmp_path), policy.actor.output.weight.clone()
    training.update(collector.collect(6, 0, 1), DroppedTransitions(), lambda: False)
    assert not torch.equal(policy.actor.output.weight, before) and training.progress.samples > 4
