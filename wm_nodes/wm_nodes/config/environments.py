"""What the settings mean that say which environment is real; schema.py has the others."""

from typing import Any

from wm_nodes.config.sections import EnvironmentName, PositiveInt, SettingsSection

NO_ENVIRONMENT = "none"
"""evaluation.environment without an environment."""


class EnvironmentConfig(SettingsSection):
    factory: EnvironmentName
    """The real environment: a name of environments/registry.py, or module:callable. The environment node serves it as
    backend `environment`; where no task is named, its spec is that of policies and recordings."""


class GymnasiumConfig(SettingsSection):
    """A Gymnasium environment, where environment.factory or evaluation.environment is gymnasium."""

    env_id: str
    """As gymnasium.make takes it, e.g. MountainCarContinuous-v0, or package:name."""
    kwargs: dict[str, Any]
    """Further arguments of gymnasium.make, e.g. {max_episode_steps: 100}."""
    pixels: str
    """Where a picture, uint8 (H, W, 3), comes from: render (it is rendered), or the key of an observation."""
    image_size: tuple[PositiveInt, PositiveInt]
    """Height and width to which the picture is resized, px."""
    state: list[str]
    """Keys of the observation whose values, joined, are the state; `observation` is one that is no mapping."""
    success: str
    """Key of info that says that the task is done; empty: the environment's `terminated` does."""
    instruction: str
    """What the episodes are for, in words."""
