"""Loop 1 on one screen: PPO, GRPO or another learner of a policy, in one process; the ROS graph gives the same weights
bit for bit. `python -m wm_nodes.policy_rl.train [--device cuda]`: learn to reach in the shipped world model."""

import argparse
from collections.abc import Iterator
from typing import Any

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.types import Environment, Rollout
from wm_nodes.policy_rl.acceptance import acceptance_when_made
from wm_nodes.policy_rl.device_rollout import make_collector
from wm_nodes.policy_rl.exploit_meter import ExploitMeter
from wm_nodes.policy_rl.factories import make_endogenous_reward, make_policy, make_training_environment
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.policy_rl.learner import Learner
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.rollouts import Convergence, TensorRollout, rollout_statistics
from wm_nodes.reward import RewardModel
from wm_nodes.world_model import DeviceEnvironment


def train_policy(
    policy: ImagePolicy, env: Environment | DeviceEnvironment, reward: RewardModel, config: RunConfig,
    meter: ExploitMeter | None = None, learner: Learner | None = None,
) -> Iterator[tuple[Rollout | TensorRollout, Any]]:
    """Train `policy` in place for ppo.updates updates, or until `meter` stops it or it converged; yield each update."""
    learner = learner or PpoLearner(policy, config.ppo, seed=config.seed)
    collect = make_collector(env, policy, reward, config.ppo.envs_per_start)  # act, step, reward
    num_steps = config.ppo.num_steps * config.ppo.num_envs // env.spec.num_envs  # however many step at a time
    versions, convergence = range(1, config.ppo.updates + 1), Convergence(config.ppo.converged_updates)
    for version in versions if meter is None else meter.watch(policy, versions):
        rollout = collect(num_steps, config.seed, version)
        yield rollout, learner.update(rollout)  # the policy is version + 1 from here on
        if convergence.reached(rollout):
            return


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m wm_nodes.policy_rl.train")
    for name, default in (("--preset", "cpu"), ("--task", "reach"), ("--device", argparse.SUPPRESS)):
        parser.add_argument(name, default=default)
    parser.add_argument("--updates", dest="ppo.updates", type=int, default=12)
    given = vars(parser.parse_args(words))
    try:
        config = load_config(given.pop("preset"), given)
        model = shipped_model(config.task)
        policy, reward = make_policy(config, model), make_endogenous_reward(config, model)
        env = make_training_environment(config, model, model / STARTS, num_envs=config.ppo.num_envs, seed=config.seed)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    for version, (rollout, _) in enumerate(train_policy(policy, env, reward, config), 1):
        print(f"version {version}: imagined success {rollout_statistics(rollout).success_rate:.1%}")
    print(f"acceptance of the world model: {acceptance_when_made(model, config)}")


if __name__ == "__main__":
    main()
