"""The door of the room: environments by the names in the settings, and their specs.

maniskill: the configured task in ManiSkill. gymnasium: settings `gymnasium`. module:callable: an environment of your
own, callable(config: RunConfig, num_envs: int, seed: int) -> Environment (core/types.py; environments/batch.py makes
one of a single robot). It may make fewer than num_envs, and of a real robot it makes one.
"""

from contextlib import closing
from dataclasses import replace

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import has_simulator
from wm_nodes.core.imports import load_factory
from wm_nodes.core.specs import SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.types import Environment
from wm_nodes.environments.maniskill.spec import simulation_spec

MANISKILL, GYMNASIUM = NAMES = ("maniskill", "gymnasium")


def make_environment(
    config: RunConfig, name: str, *, num_envs: int, seed: int, pictures: bool = True
) -> Environment:
    """Return the environment of that name, of config.environment.factory or config.evaluation.environment.

    Args:
        pictures: False: where it can leave them black, it does; a step is then faster.

    Raises:
        ValueError: none can be made by the settings; says which. Or a real robot was made several times.
    """
    environment: Environment
    if name == MANISKILL:
        configured_task(config)
        from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment

        environment = ManiSkillEnvironment(
            config.task, config.simulation, num_envs=num_envs, seed=seed, pictures=pictures
        )
    elif name == GYMNASIUM:
        from wm_nodes.environments.gymnasium_environment import gymnasium_environment

        environment = gymnasium_environment(config.gymnasium, num_envs, seed)
    elif ":" not in name:
        raise ValueError(f"no environment {name!r}; choose one of {', '.join(NAMES)}, or module:callable")
    else:
        environment = load_factory(name)(config, num_envs, seed)
    spec = environment.spec
    if spec.source == SOURCE_REAL and spec.num_envs > 1:
        environment.close()
        raise ValueError(
            f"num_envs is {spec.num_envs}, and {spec.env_id} is a real robot, of which there is one: have {name} make "
            "one, however many are asked for; or ask for one by num_envs:=1 and simulator_envs:=1, or ppo.num_envs 1"
        )
    return environment


def configured_spec(config: RunConfig, num_envs: int = 1) -> EnvironmentSpec:
    """The spec of the configured task in its simulator; where it has none that of environment.factory, of which one is
    made and closed again.

    Raises:
        ValueError: as make_environment.
    """
    name = config.environment.factory
    if has_simulator(config.task) or name == MANISKILL:
        return simulation_spec(configured_task(config), config.simulation, num_envs)
    with closing(make_environment(config, name, num_envs=1, seed=config.seed)) as environment:
        return replace(environment.spec, num_envs=num_envs)


def configured_task(config: RunConfig) -> str:
    """The task that ManiSkill simulates. Raises ValueError: none is configured."""
    if not config.task:
        raise ValueError(
            "task is empty, and environment maniskill simulates a task: name one, or another environment in "
            "environment.factory and evaluation.environment"
        )
    return config.task


def is_simulated(config: RunConfig) -> bool:
    """Whether episodes of the configured task can be played, planned and replayed, and policies are measured there."""
    return has_simulator(config.task) and config.evaluation.environment == MANISKILL
