"""What the settings mean that say which environment is real; schema.py has the others."""

from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from wm_nodes.config.sections import EnvironmentName, PositiveFloat, PositiveInt, SettingsSection

NO_ENVIRONMENT = "none"
"""evaluation.environment without an environment."""
RENDER, CAMERAS = "render", "cameras"
"""gymnasium.pixels of an environment whose picture is what it renders, or what the cameras show."""


class EnvironmentConfig(SettingsSection):
    factory: EnvironmentName
    """The real environment: a name of environments/registry.py, or module:callable. The environment node serves it as
    backend `environment`; where no task is named, its spec is that of policies and recordings."""


class CameraView(SettingsSection):
    """A camera that hangs in a MuJoCo scene."""

    lookat_m: tuple[float, float, float]
    """Point (x, y, z) in the middle of the picture, world frame."""
    distance_m: PositiveFloat
    """From that point."""
    azimuth_deg: float
    """Direction in which it looks: 0 along x, 90 along y."""
    elevation_deg: float
    """-90 looks straight down."""


class GymnasiumConfig(SettingsSection):
    """A Gymnasium environment, where environment.factory or evaluation.environment is gymnasium."""

    env_id: str
    """As gymnasium.make takes it, e.g. MountainCarContinuous-v0, or package:name."""
    kwargs: dict[str, Any]
    """Further arguments of gymnasium.make, e.g. {max_episode_steps: 100}."""
    pixels: str
    """Where a picture, uint8 (H, W, 3), comes from: render (it is rendered), cameras, or the key of an observation."""
    cameras: dict[str, CameraView]
    """Views by name, side by side in the picture, of an environment of MuJoCo (requirements/gym.txt)."""
    image_size: tuple[PositiveInt, PositiveInt]
    """Height and width of the picture, of each where there are several, px; another one is resized."""
    action_scale: Annotated[float, Field(gt=0, le=1)]
    """Share of the environment's range that an action of 1 takes."""
    state: list[str]
    """Keys of the observation whose values, joined, are the state; key.i is one value. `observation` is one that is no
    mapping."""
    success: str
    """Key of info that says that the task is done; empty: the environment's `terminated` does."""
    measures: list[str]
    """Keys of info whose numbers are published and recorded beside success, as ground truth."""
    instruction: str
    """What the episodes are for, in words."""

    @model_validator(mode="after")
    def _check_cameras(self) -> Self:
        if self.pixels == CAMERAS and not self.cameras:
            raise ValueError("pixels is cameras, and cameras names none")
        return self
