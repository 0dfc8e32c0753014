"""Where the cameras of the simulated scenes are, for who reads their pictures. No simulator is started."""

from collections.abc import Callable

import numpy as np

from wm_nodes.config.environments import SimulationConfig
from wm_nodes.core.cameras import CameraModel
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE as ROBOT_BASE
from wm_nodes.environments.maniskill.cameras import hand_over, table_top_cameras


def simulated_cameras(config: SimulationConfig, state_of: Callable[[int], FloatArray]) -> tuple[CameraModel, ...]:
    """The cameras of config.cameras in the robot's base frame, whose origin is ROBOT_BASE, m, in the world.

    Args:
        state_of: environment 0 to N - 1 -> commanded tool (S,), which carries the camera on the hand.
    """
    return table_top_cameras(config, lambda env: hand_over(state_of(env)))


def still_camera(config: SimulationConfig, size: int) -> tuple[int, CameraModel]:
    """Which view of a frame is that of the first camera that does not move, and that camera, for pictures `size` px
    high.

    Raises:
        ValueError: all of them move.
    """
    cameras = simulated_cameras(config.model_copy(update={"image_size": size}), lambda _: np.zeros(3, np.float32))
    still = [(index, camera) for index, camera in enumerate(cameras) if not camera.moves]
    if not still:
        raise ValueError(f"cameras {config.cameras} all move; faults are read in a still one, such as side")
    return still[0]
