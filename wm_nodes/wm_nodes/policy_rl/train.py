"""Loop 1 on one screen: PPO of a policy in an environment, in one process.

The ROS graph is this loop with the environment, the policy, the reward and the learner in a process each, and gives the
same weights bit for bit (tests/graph/test_training.py). `python -m wm_nodes.policy_rl.train` runs it: a policy that
knows nothing learns to reach in the shipped world model, seconds per update, no simulator.
"""

from collections.abc import Iterator

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.types import Environment, Rollout
from wm_nodes.policy_rl.factories import make_endogenous_reward, make_imagined_environment, make_policy
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.policy_rl.ppo import PpoLearner, PpoMetrics
from wm_nodes.policy_rl.rollouts import collect_rollout, rollout_statistics
from wm_nodes.reward import RewardModel


def train_policy(
    policy: ImagePolicy, env: Environment, reward: RewardModel, config: RunConfig
) -> Iterator[tuple[Rollout, PpoMetrics]]:
    """Train `policy` in place for ppo.updates updates; yield the rollout and the metrics of each.

    A rollout has ppo.num_steps x ppo.num_envs environment steps, however many environments `env` steps at a time.
    """
    learner = PpoLearner(policy, config.ppo, seed=config.seed)
    num_steps = config.ppo.num_steps * config.ppo.num_envs // env.spec.num_envs
    for version in range(1, config.ppo.updates + 1):
        rollout = collect_rollout(env, policy, reward, num_steps, config.seed, version)  # act, step, reward
        metrics = learner.update(rollout)  # the policy is version + 1 from here on
        yield rollout, metrics


def main() -> None:
    config = load_config("cpu", {"task": "reach", "ppo.updates": 12})
    model_dir = shipped_model(config.task)
    policy = make_policy(config, model_dir)
    env = make_imagined_environment(
        config, model_dir, model_dir / STARTS, num_envs=config.ppo.num_envs, seed=config.seed
    )
    reward = make_endogenous_reward(config, model_dir)
    for version, (rollout, metrics) in enumerate(train_policy(policy, env, reward, config), 1):
        success = rollout_statistics(rollout).success_rate
        print(f"version {version}: imagined success {success:.1%}, {metrics.kl_reference:.3f} nats from version 1")


if __name__ == "__main__":
    main()
