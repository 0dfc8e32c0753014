"""The door of the room: what a configuration says of its environment, without starting it."""

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.environments.maniskill.spec import simulation_spec


def configured_spec(config: RunConfig, num_envs: int = 1) -> EnvironmentSpec:
    """The spec of the configured task in its simulator.

    Raises:
        ValueError: no task is configured: the spec is that of an environment, a recording or a model.
    """
    if not config.task:
        raise ValueError("task is empty: the simulator has no spec of it; name a task, or take the spec of a model")
    return simulation_spec(config.task, config.simulation, num_envs)
