"""The spec of a task in ManiSkill."""

from wm_nodes.config.environments import SimulationConfig
from wm_nodes.config.tasks import get_task, instruction, simulator_part
from wm_nodes.core.action_spaces import MAX_TILT_RAD, MAX_YAW_RAD, SPACES, ActionSpace
from wm_nodes.core.specs import SOURCE_SIMULATOR, TASK_PREFIX, EnvironmentSpec

FARTHEST_M = 10.0
"""Of a thing from the robot's base, along each axis."""


def simulation_spec(task: str, config: SimulationConfig, num_envs: int) -> EnvironmentSpec:
    """The spec of `task` in ManiSkill; the imagined environment shares all but env_id, source and ground truth.

    Raises:
        ValueError: the task has no simulator's part.
    """
    space, known = SPACES[simulator_part(task).actions], get_task(task)
    low, high = _box(space, config)
    full = {"m": config.max_action_m, "rad": config.max_action_rad, "1": 1.0}
    codes = tuple(TASK_PREFIX + part for part in known.parts)
    things = object_state_names(task, config)
    return EnvironmentSpec(
        env_id=f"maniskill/{task}", task=task, instruction=instruction(task, config.scenes), source=SOURCE_SIMULATOR,
        num_envs=num_envs, height=config.image_size, width=config.image_size * len(config.cameras),
        cameras=tuple(config.cameras), action_names=space.action_names, action_units=space.units,
        action_scale=tuple(full[unit] for unit in space.units), state_names=space.state_names + things + codes,
        state_units=space.units + ("m",) * len(things) + ("1",) * len(codes),
        ground_truth_names=known.ground_truth_names, control_period_s=1.0 / config.control_hz,
        max_episode_steps=config.max_episode_steps, state_low=low + (-FARTHEST_M,) * len(things) + (0.0,) * len(codes),
        state_high=high + (FARTHEST_M,) * len(things) + (1.0,) * len(codes),
    )


def object_state_names(task: str, config: SimulationConfig) -> tuple[str, ...]:
    """The values of a state that say where things are; () without simulation.object_state.

    Raises:
        ValueError: the task has none.
    """
    if not config.object_state:
        return ()
    if not (names := simulator_part(task).object_state):
        raise ValueError(f"simulation.object_state is {config.object_state}, and task {task} says of nothing where it "
                         "is; leave it empty")
    return names


def _box(space: ActionSpace, config: SimulationConfig) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Least and largest commanded state."""
    rest = (MAX_TILT_RAD, MAX_TILT_RAD, MAX_YAW_RAD, 1.0)[: len(space.units) - 3]
    return (*config.workspace_low_m, *(-limit for limit in rest)), (*config.workspace_high_m, *rest)
