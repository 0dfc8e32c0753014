"""Pictures of cameras in a MuJoCo environment of Gymnasium, made fast: one renderer for all copies of the environment,
without multisampling, shadows, reflections and sky."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from wm_nodes.config.environments import CameraView
from wm_nodes.core.imports import optional_package
from wm_nodes.core.types import UInt8Array


def choose_headless() -> None:
    """Let MuJoCo, where it is not imported yet, draw without a display if there is none."""
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")


class MujocoCameras:
    """Draws with the model of the first environment that it is asked for; the others must have an equal one.

    Args:
        image_size: height and width of each picture, px.
    """

    def __init__(self, views: Mapping[str, CameraView], image_size: tuple[int, int]) -> None:
        self._views, self._size = views, image_size
        self._renderer: Any = None

    def __call__(self, environment: Any) -> UInt8Array:
        """The pictures side by side, uint8 (H, W, 3), of an unwrapped environment. Raises ValueError: not of MuJoCo."""
        if not (hasattr(environment, "model") and hasattr(environment, "data")):
            kind = type(environment).__name__
            raise ValueError(f"gymnasium.pixels cameras needs an environment of MuJoCo, not {kind}")
        if self._renderer is None:
            self._begin(environment.model)
        draw_marks = getattr(environment, "_render_callback", None)  # of gymnasium-robotics: the goal's mark
        if draw_marks is not None:
            draw_marks()
        return np.concatenate([self._picture(environment.data, camera) for camera in self._cameras], 1)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _begin(self, model: Any) -> None:
        mujoco = optional_package("mujoco", needed_by="gymnasium.cameras need", requirements="gym.txt")
        model.vis.quality.offsamples = 0
        self._renderer = mujoco.Renderer(model, *self._size)
        for name in ("SHADOW", "REFLECTION", "SKYBOX"):
            self._renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{name}")] = False
        self._cameras = []
        for view in self._views.values():
            camera = mujoco.MjvCamera()
            camera.lookat[:], camera.distance = view.lookat_m, view.distance_m
            camera.azimuth, camera.elevation = view.azimuth_deg, view.elevation_deg
            self._cameras.append(camera)

    def _picture(self, data: Any, camera: Any) -> UInt8Array:
        self._renderer.update_scene(data, camera)
        picture: UInt8Array = self._renderer.render()
        return picture
