"""What the settings mean that say which environment is real; schema.py has the others."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from wm_nodes.config.scenes import check_scenes
from wm_nodes.config.sections import EnvironmentName, PositiveFloat, PositiveInt, SettingsSection

NO_ENVIRONMENT = "none"
"""evaluation.environment without an environment."""
RENDER, CAMERAS = "render", "cameras"
"""gymnasium.pixels of an environment whose picture is what it renders, or what the cameras show."""
TRUTH = "truth"
"""Of simulation.object_state: as the simulator knows it."""
ScenesName = Annotated[str, AfterValidator(check_scenes)]
"""Name of a split or of a scene, see config/scenes.py."""


class EnvironmentConfig(SettingsSection):
    factory: EnvironmentName
    """The real environment: a name of environments/registry.py, or module:callable. The environment node serves it as
    backend `environment`; where no task is named, its spec is that of policies and recordings."""


class SimulationConfig(SettingsSection):
    scenes: ScenesName = ""
    """Of which scenes an episode has one, by its reset seed: a split of config/scenes.json, or one scene's name. Empty:
    the task has a scene of its own."""
    cameras: Annotated[list[Literal["side", "near", "front", "wrist"]], Field(min_length=1)]
    """Rendered side by side, left to right, in every observation."""
    image_size: PositiveInt
    """Height and width of one camera image, px."""
    control_hz: PositiveFloat
    """Policy and world-model steps per simulated second."""
    max_action_m: PositiveFloat
    """Displacement of the commanded tool position by a full-scale action, m per axis and step."""
    max_action_rad: PositiveFloat = 0.2
    """Rotation of the commanded tool by a full-scale action, rad per axis and step; only where Task.actions is pose."""
    workspace_low_m: tuple[float, float, float]
    """Lower corner (x, y, z) of the box that the commanded tool position stays in, robot base frame, m."""
    workspace_high_m: tuple[float, float, float]
    """Upper corner of that box."""
    max_episode_steps: PositiveInt
    """An episode is truncated after this many steps."""
    render_device: str
    """SAPIEN render device; `auto` takes a GPU when there is one, else the software device."""
    object_state: str = ""
    """Where the state says, beside the commanded tool, where the things are that the task names: truth: as the
    simulator knows it; a file: as that reader (environments/object_reader.py) sees it in the picture. Empty: it does
    not say it, or, in a world model's folder with a reader, as that reader sees it."""


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
