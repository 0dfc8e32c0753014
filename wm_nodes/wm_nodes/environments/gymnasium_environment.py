"""Any Gymnasium environment as ours: settings `gymnasium`. Copies step one after the other in this process.

gym.py goes the other way: our tasks for Gymnasium.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import gymnasium
import numpy as np

from wm_nodes.config.environments import CAMERAS, RENDER, GymnasiumConfig
from wm_nodes.core.specs import SOURCE_SIMULATOR, EnvironmentSpec
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.environments.batch import EnvironmentBatch, Frame
from wm_nodes.environments.mujoco_cameras import MujocoCameras, choose_headless


def gymnasium_environment(config: GymnasiumConfig, num_envs: int, seed: int) -> EnvironmentBatch:
    """Make num_envs copies. Raises ValueError: an environment that does not exist or does not fit the settings."""
    cameras = MujocoCameras(config.cameras, config.image_size)
    copies = [GymnasiumCopy(config, cameras) for _ in range(num_envs)]
    return EnvironmentBatch(copies[0].spec(), copies, seed)


class GymnasiumCopy:
    """One of the copies: pictures of gymnasium.image_size, actions of [-1, 1] over its Box, measured states.

    An end that the environment calls terminated, but not a success, has failed for good.
    """

    def __init__(self, config: GymnasiumConfig, cameras: MujocoCameras) -> None:
        self._config, self._cameras = config, cameras
        rendered = {"render_mode": "rgb_array"} if config.pixels == RENDER else {}
        if config.pixels == CAMERAS:
            choose_headless()
        try:
            self._env: gymnasium.Env[Any, Any] = gymnasium.make(config.env_id, **{**rendered, **config.kwargs})
        except (gymnasium.error.Error, ImportError, TypeError) as error:
            raise ValueError(
                f"gymnasium.env_id {config.env_id!r} with gymnasium.kwargs {config.kwargs}: {error}; a package that "
                "registers it is named as package:name"
            ) from None
        box = self._env.action_space
        if not isinstance(box, gymnasium.spaces.Box) or box.shape != (box.low.size,) or not box.is_bounded():
            raise ValueError(f"{config.env_id} takes actions of {box}; only a bounded, flat Box can be scaled")
        self._middle, self._half = (box.high + box.low) / 2, config.action_scale * (box.high - box.low) / 2

    def spec(self) -> EnvironmentSpec:
        config, made = self._config, self._env.spec
        limit = made.max_episode_steps if made else None
        if not limit:
            raise ValueError(f"{config.env_id} sets no limit to an episode; give gymnasium.kwargs max_episode_steps")
        height, width = config.image_size
        cameras = tuple(config.cameras) if config.pixels == CAMERAS else (config.pixels,)
        states = list(self._state(self._env.observation_space.sample()))
        return EnvironmentSpec(
            env_id=f"gymnasium/{config.env_id}", task=config.env_id, instruction=config.instruction,
            source=SOURCE_SIMULATOR, num_envs=1, height=height, width=width * len(cameras), cameras=cameras,
            action_names=tuple(f"action.{i}" for i in range(len(self._half))), action_units=("1",) * len(self._half),
            action_scale=tuple(map(float, self._half)), state_names=tuple(states), state_units=("1",) * len(states),
            ground_truth_names=tuple(config.measures), max_episode_steps=limit,
            control_period_s=1 / float(self._env.metadata.get("render_fps") or 10),
        )

    def reset(self, seed: int) -> Frame:
        return self._frame(*self._env.reset(seed=seed % 2**31))

    def step(self, action: FloatArray) -> Frame:
        taken = (self._middle + self._half * action).astype(self._env.action_space.dtype)
        observed, _, terminated, truncated, info = self._env.step(taken)
        success = bool(info.get(self._config.success)) if self._config.success else bool(terminated)
        if absent := [name for name in self._config.measures if name not in info]:
            raise ValueError(f"gymnasium.measures names {absent}, and info has {sorted(info)}")
        return self._frame(observed, info, success=success, over=bool(truncated), failed=bool(terminated))

    def close(self) -> None:
        self._cameras.close()
        self._env.close()

    def _frame(self, observed: Any, info: Mapping[str, Any], **ends: bool) -> Frame:
        pixels = self._config.pixels
        if pixels == CAMERAS:
            image = self._cameras(self._env.unwrapped)
        else:
            image = self._resized(np.asarray(self._env.render() if pixels == RENDER else _part(observed, pixels)))
        truth = [float(info.get(name, np.nan)) for name in self._config.measures]
        return Frame(image, np.array([*self._state(observed).values()], np.float32), truth=truth, **ends)

    def _resized(self, image: UInt8Array) -> UInt8Array:
        pixels = self._config.pixels
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"gymnasium.pixels {pixels!r} gives {image.dtype} {image.shape}, not uint8 (H, W, 3)")
        height, width = self._config.image_size
        if image.shape[:2] != (height, width):
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return image

    def _state(self, observed: Any) -> dict[str, float]:
        """The values of the state, by their names."""
        values = dict[str, float]()
        for name in self._config.state:
            key, dot, index = name.rpartition(".")
            one = bool(dot) and index.isdigit()
            part = np.ravel(_part(observed, key if one else name))
            if one and int(index) >= len(part):
                raise ValueError(f"gymnasium.state names {name}, and {key} has {len(part)} values")
            values |= {name: part[int(index)]} if one else {f"{name}.{i}": value for i, value in enumerate(part)}
        return values


def _part(observed: Any, key: str) -> Any:
    """The value of an observation of that name; an observation that is no mapping has one, called observation."""
    values: Mapping[str, Any] = observed if isinstance(observed, Mapping) else {"observation": observed}
    if key not in values:
        raise ValueError(f"an observation has no {key!r}; gymnasium.state and .pixels may name {sorted(values)}")
    return values[key]
