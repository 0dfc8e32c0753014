"""Pendulum-v1 of Gymnasium, drawn without pygame: drawn_pendulum:drawn-v0, done within 60 degrees of upright."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from numpy.typing import NDArray

SIDE_PX = 40


class DrawnPendulum(PendulumEnv):
    def step(self, u: NDArray[np.float32]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observed, reward, terminated, truncated, _ = super().step(u)
        return observed, reward, terminated, truncated, {"upright": observed[0] > 0.5, "height": observed[0]}

    def render(self) -> NDArray[np.uint8]:
        image = np.full((SIDE_PX, SIDE_PX, 3), (30, 40, 60), np.uint8)
        theta = self.state[0]
        along = np.linspace(0, 15, 40)[:, None] * (-np.cos(theta), -np.sin(theta)) + SIDE_PX / 2
        for row, column in along.astype(int):
            image[row - 2 : row + 2, column - 2 : column + 2] = (230, 120, 40)
        return image


gymnasium.register("drawn-v0", entry_point=DrawnPendulum, max_episode_steps=8)
SETTINGS = {
    "task": "", "environment.factory": "gymnasium", "gymnasium.env_id": "drawn_pendulum:drawn-v0",
    "gymnasium.image_size": [32, 32], "gymnasium.success": "upright",
}
