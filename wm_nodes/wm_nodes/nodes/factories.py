"""What stands behind the names in parameters: environments, reward models, policies. The nodes' only knowledge of them.

Plug-in point: `backend_factory` = "module:callable" builds any Environment, e.g. a real robot's, as
callable(config: RunConfig, num_envs: int, seed: int) -> Environment.
"""

import importlib
from pathlib import Path
from typing import Any

from wm_msgs.msg import ErrorCode
from wm_nodes.config.schema import AGENT, RunConfig
from wm_nodes.core.specs import EnvironmentSpec, SpecMismatch, agree
from wm_nodes.core.types import Environment
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.learner import Learner
from wm_nodes.reward import RewardModel
from wm_nodes.ros.wire import WireError
from wm_nodes.training.ranks import Ranks

BACKENDS = ("world_model", "video_model", "maniskill", "factory")
REWARDS = ("endogenous", "rule", AGENT)
"""The agent judges whole episodes (judge/episode_reward.py), so it is no RewardModel of make_reward."""


def load_factory(path: str) -> Any:
    """Return the callable behind "module:callable".

    Raises:
        ValueError: wrong form, no such module or no such name in it.
    """
    module_name, separator, name = path.partition(":")
    if not separator or not module_name or not name:
        raise ValueError(f"a factory is written module:callable, got {path!r}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ValueError(f"factory {path!r}: {error}; put its folder on PYTHONPATH") from None
    if not callable(getattr(module, name, None)):
        raise ValueError(f"factory {path!r}: module {module_name} has no callable {name!r}")
    return getattr(module, name)


def make_environment(
    backend: str, config: RunConfig, *, num_envs: int, seed: int, model_dir: str, starts_file: str, factory: str,
    video_model_dir: str = "",
) -> Environment:
    """Build the environment that a node serves.

    Raises:
        ValueError: a missing or wrong setting. OSError: a file that does not exist.
    """
    if backend == "maniskill":
        from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment

        return ManiSkillEnvironment(config.task, config.simulation, num_envs=num_envs, seed=seed)
    if backend == "factory":
        environment: Environment = load_factory(factory)(config, num_envs, seed)
        return environment
    from wm_nodes.policy_rl.factories import make_imagined_environment, make_video_environment

    name, folder = ("model_dir", model_dir) if backend == "world_model" else ("video_model_dir", video_model_dir)
    model, starts = existing(folder, name), existing(starts_file, "starts_file")
    if backend == "video_model":
        return make_video_environment(config, model, starts, num_envs=num_envs, seed=seed)
    return make_imagined_environment(config, model, starts, num_envs=num_envs, seed=seed, training=True)


def make_reward(kind: str, config: RunConfig, model_dir: str, factory: str = "") -> RewardModel:
    """Build a reward model."""
    from wm_nodes.reward import RuleReward

    if factory:
        reward: RewardModel = load_factory(factory)(config)
        return reward
    if kind == "rule":
        return RuleReward(config.reward.sparse_weight)
    folder = existing(model_dir, "model_dir")
    from wm_nodes.policy_rl.factories import make_endogenous_reward

    return make_endogenous_reward(config, folder)


def make_policy(config: RunConfig, model_dir: str, factory: str = "") -> ImagePolicy:
    """Build a policy with fresh weights."""
    if factory:
        policy: ImagePolicy = load_factory(factory)(config)
        return policy
    folder = existing(model_dir, "model_dir")
    from wm_nodes.policy_rl.factories import make_policy as make_model_policy

    return make_model_policy(config, folder)


def expected_spec(config: RunConfig, model_dir: str, policy_factory: str) -> EnvironmentSpec | None:
    """The robot and cameras that the policy of make_policy was made for; None for a factory's, which tells nothing."""
    if policy_factory or not model_dir:
        return None
    from wm_nodes.policy_rl.factories import run_spec

    return run_spec(config, Path(model_dir))


def refuse_other(served: EnvironmentSpec, expected: EnvironmentSpec, whose: str) -> None:
    """Raise WireError(SPEC_MISMATCH) unless both agree, see core.specs.agree."""
    try:
        agree(served, expected, whose)
    except SpecMismatch as error:
        raise WireError(ErrorCode.SPEC_MISMATCH, str(error)) from None


def make_learner(policy: ImagePolicy, config: RunConfig, factory: str = "", ranks: Ranks | None = None) -> Learner:
    """Build the algorithm that trains `policy` in place; its present weights are the reference it stays close to."""
    if factory:
        learner: Learner = load_factory(factory)(policy, config)
        return learner
    from wm_nodes.policy_rl.ppo import PpoLearner

    return PpoLearner(policy, config.ppo, seed=config.seed, ranks=ranks)


def existing(path: str, parameter: str) -> Path:
    """Return an existing path. Raises ValueError for an empty one, FileNotFoundError for a missing one."""
    if not path:
        raise ValueError(f"parameter {parameter} is empty; name a file or folder")
    if not Path(path).exists():
        raise FileNotFoundError(f"{parameter} {path!r} does not exist")
    return Path(path)
