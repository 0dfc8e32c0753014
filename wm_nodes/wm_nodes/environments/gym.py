"""Every task as a Gymnasium environment, wm/<task>-v0; importing this module registers them. policy_rl/gym.py has the
world model.

    import wm_nodes.environments.gym
    env = gymnasium.make("wm/push-v0", scenes="train", image_size=128)

or without the import, gymnasium.make("wm_nodes.environments.gym:wm/push-v0").
"""

from typing import Any

import gymnasium
import numpy as np

from wm_nodes.config.load import load_config
from wm_nodes.config.tasks import task_names
from wm_nodes.core.types import FloatArray, Observation, UInt8Array
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.spaces import action_space, observation_space


class TaskEnv(gymnasium.Env[dict[str, Any], FloatArray]):
    """One task in ManiSkill. Observations: image uint8 (H, W, 3), cameras side by side, and state (S,), the commanded
    tool; actions (A,) in [-1, 1]; see core/action_spaces.py.

    The reward is 1 on the step that succeeds, and ends the episode. info: ground_truth by name, instruction, scene (of
    the catalogue, "" where the task has one of its own), success.

    Args:
        simulation: settings of SimulationConfig over those of the task, e.g. scenes, cameras, image_size.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, task: str, render_mode: str | None = None, **simulation: Any) -> None:
        settings = {f"simulation.{name}": value for name, value in simulation.items()}
        config = load_config("base", {"task": task, **settings})
        self._env = ManiSkillEnvironment(task, config.simulation)
        spec = self._env.spec
        self.metadata = {**self.metadata, "render_fps": config.simulation.control_hz}
        self.render_mode = render_mode
        self.observation_space, self.action_space = observation_space(spec), action_space(spec)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """seed: decides the scene and where everything lies; None: one that follows from the seed before."""
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31)) if seed is None else seed
        observation = self._env.reset(seeds=np.array([drawn], np.uint64))
        return _shown(observation), self._info(success=False)

    def step(self, action: FloatArray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        result = self._env.step(np.asarray(action, np.float32)[None])
        success = bool(result.success[0])
        info = self._info(success)
        return _shown(result.observation), float(success), bool(result.terminated[0]), bool(result.truncated[0]), info

    def render(self) -> UInt8Array | None:
        return self._env.current().image[0] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        self._env.close()

    def _info(self, success: bool) -> dict[str, Any]:
        truth = dict(zip(self._env.spec.ground_truth_names, self._env.ground_truth[0].tolist(), strict=True))
        scene = self._env.shown_scenes[0]
        return {
            "ground_truth": truth, "instruction": self._env.instructions[0], "scene": scene.name if scene else "",
            "success": success,
        }


def _shown(observation: Observation) -> dict[str, Any]:
    return {"image": observation.image[0], "state": observation.state[0]}


for _task in task_names():
    gymnasium.register(f"wm/{_task}-v0", entry_point=f"{__name__}:TaskEnv", kwargs={"task": _task})
