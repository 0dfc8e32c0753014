"""What stands behind the names in parameters: environments, reward models, policies. The nodes' only knowledge of them.

What is of somebody else's is named in the settings: environment.factory, reward.factory, policy.factory,
learner.factory.
"""

from pathlib import Path

from wm_msgs.msg import ErrorCode
from wm_nodes.config.schema import AGENT, RunConfig
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import EnvironmentSpec, SpecMismatch, agree
from wm_nodes.core.types import Environment
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.reward import RewardModel

BACKENDS = ("world_model", "video_model", "environment", "evaluation")
"""environment, evaluation: that of environment.factory, and of evaluation.environment, in the configuration."""
REWARDS = ("endogenous", "rule", AGENT)
"""The agent judges whole episodes (judge/episode_reward.py), so it is no RewardModel of make_reward."""


def make_environment(
    backend: str, config: RunConfig, *, num_envs: int, seed: int, model_dir: str, starts_file: str,
    video_model_dir: str = "",
) -> Environment:
    """Build the environment that a node serves.

    Raises:
        ValueError: a missing or wrong setting. OSError: a file that does not exist.
    """
    if backend in ("environment", "evaluation"):
        from wm_nodes.environments import registry

        name = config.environment.factory if backend == "environment" else config.evaluation.environment
        return registry.make_environment(config, name, num_envs=num_envs, seed=seed)
    from wm_nodes.policy_rl.factories import make_imagined_environment, make_video_environment

    name, folder = ("model_dir", model_dir) if backend == "world_model" else ("video_model_dir", video_model_dir)
    model, starts = existing(folder, name), existing(starts_file, "starts_file")
    if backend == "video_model":
        return make_video_environment(config, model, starts, num_envs=num_envs, seed=seed)
    return make_imagined_environment(config, model, starts, num_envs=num_envs, seed=seed, training=True)


def make_reward(kind: str, config: RunConfig, model_dir: str) -> RewardModel:
    """Build a reward model."""
    from wm_nodes.reward import RuleReward

    if kind == "rule" and not config.reward.factory:
        return RuleReward(config.reward.sparse_weight)
    folder = None if config.reward.factory else existing(model_dir, "model_dir")
    from wm_nodes.policy_rl import factories

    return factories.make_reward(config, folder)


def make_policy(config: RunConfig, model_dir: str) -> ImagePolicy:
    """Build a policy with fresh weights."""
    folder = None if config.policy.foreign else existing(model_dir, "model_dir")
    from wm_nodes.policy_rl import factories

    return factories.make_policy(config, folder)


def expected_spec(config: RunConfig, model_dir: str) -> EnvironmentSpec | None:
    """The robot and cameras that the policy of make_policy was made for; None for a factory's, which tells nothing."""
    if config.policy.factory or not model_dir:
        return None
    from wm_nodes.policy_rl.factories import run_spec

    return run_spec(config, Path(model_dir))


def refuse_for_policy(served: EnvironmentSpec, expected: EnvironmentSpec | None, policy: ImagePolicy) -> None:
    """Raise WireError(SPEC_MISMATCH) unless a policy can act in this environment. expected: of expected_spec."""
    if expected is not None:
        refuse_other(served, expected, "the policy needs")
    found, needed = (served.state_dim, served.action_dim), (policy.state_dim, policy.action_dim)
    if found != needed:
        raise WireError(
            ErrorCode.SPEC_MISMATCH,
            f"environment {served.env_id} has {found} state and action values, the policy {needed}; "
            "name a policy of this robot in policy.factory",
        )


def refuse_other(served: EnvironmentSpec, expected: EnvironmentSpec, whose: str) -> None:
    """Raise WireError(SPEC_MISMATCH) unless both agree, see core.specs.agree."""
    try:
        agree(served, expected, whose)
    except SpecMismatch as error:
        raise WireError(ErrorCode.SPEC_MISMATCH, str(error)) from None


def existing(path: str, parameter: str) -> Path:
    """Return an existing path. Raises ValueError for an empty one, FileNotFoundError for a missing one."""
    if not path:
        raise ValueError(f"parameter {parameter} is empty; name a file or folder")
    if not Path(path).exists():
        raise FileNotFoundError(f"{parameter} {path!r} does not exist")
    return Path(path)
