"""The spec of a task in ManiSkill."""

from wm_nodes.config.schema import SimulationConfig
from wm_nodes.config.tasks import get_task, instruction
from wm_nodes.core.action_spaces import SPACES
from wm_nodes.core.specs import SOURCE_SIMULATOR, TASK_PREFIX, EnvironmentSpec


def simulation_spec(task: str, config: SimulationConfig, num_envs: int) -> EnvironmentSpec:
    """The spec of `task` in ManiSkill; the imagined environment shares all but env_id, source and ground truth."""
    what = get_task(task)
    space = SPACES[what.actions]
    low, high = space.box(config)
    codes = tuple(TASK_PREFIX + part for part in what.parts)
    return EnvironmentSpec(
        env_id=f"maniskill/{task}", task=task, instruction=instruction(task, config.scenes), source=SOURCE_SIMULATOR,
        num_envs=num_envs, height=config.image_size, width=config.image_size * len(config.cameras),
        cameras=tuple(config.cameras), action_names=space.action_names, action_units=space.units,
        action_scale=space.scale(config), state_names=space.state_names + codes,
        state_units=space.units + ("1",) * len(codes),
        ground_truth_names=what.ground_truth_names, control_period_s=1.0 / config.control_hz,
        max_episode_steps=config.max_episode_steps, state_low=low + (0.0,) * len(codes),
        state_high=high + (1.0,) * len(codes),
    )
