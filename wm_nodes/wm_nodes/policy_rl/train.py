"""Loop 1 on one screen: PPO or GRPO of a policy in an environment, in one process; the ROS graph gives the same weights
bit for bit. `python -m wm_nodes.policy_rl.train`: a policy learns to reach in the shipped world model (--device cuda);
`--task ""`: in the environment of environment.factory itself, or in the model of it that --model-dir names."""

import argparse
import sys
from collections.abc import Iterator
from typing import Any

from wm_nodes.config.load import load_config, split_settings
from wm_nodes.config.object_state import with_reader
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import Environment, Rollout
from wm_nodes.policy_rl import factories
from wm_nodes.policy_rl.device_rollout import make_collector
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import Convergence, TensorRollout, rollout_statistics
from wm_nodes.policy_rl.validation import acceptance, exploit_meter
from wm_nodes.reward import RewardModel
from wm_nodes.world_model import DeviceEnvironment


def train_policy(
    policy: ImagePolicy, env: Environment | DeviceEnvironment, reward: RewardModel, config: RunConfig,
    meter: exploit_meter.ExploitMeter | None = None,
) -> Iterator[tuple[Rollout | TensorRollout, Any]]:
    """Train `policy` in place for ppo.updates updates, or until `meter` stops it or it converged; yield each update."""
    learner = factories.make_learner(policy, config)  # PPO, unless learner.factory names another
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
    for name, default in zip(("preset", "task", "device", "model-dir"), ("cpu", "reach", argparse.SUPPRESS, "")):
        parser.add_argument(f"--{name}", default=default)
    parser.add_argument("--updates", dest="ppo.updates", type=int, default=12)
    try:
        options, settings = split_settings(sys.argv[1:] if words is None else words)
        given = vars(parser.parse_args(options))
        folder, config = given.pop("model_dir"), load_config(given.pop("preset"), given | settings)
        config = with_reader(config, model := factories.chosen_model(config, folder))
        policy, reward = factories.make_policy(config, model), factories.make_reward(config, model, golden=True)
        env = factories.make_training_environment(config, model, num_envs=config.ppo.num_envs, seed=config.seed)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    for version, (rollout, _) in enumerate(train_policy(policy, env, reward, config), 1):
        shown = "imagined" if model else "real"
        print(f"version {version}: {shown} success {rollout_statistics(rollout).success_rate:.1%}")
    print(f"acceptance of the world model: {acceptance.acceptance_when_made(model, config)}")


if __name__ == "__main__":
    main()
