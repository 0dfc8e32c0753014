"""ManiSkill behind the Environment interface: N scenes stepped in turn in one process, images from two cameras.

Shapes: N environments, A action, S state, P ground truth.
"""

from pathlib import Path

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv

from wm_nodes.config.environments import TRUTH, SimulationConfig
from wm_nodes.config.scenes import Scene, scene_of
from wm_nodes.config.seed_ranges import UNSEEDED
from wm_nodes.config.tasks import get_task, part_of, simulator_part, success
from wm_nodes.core.cameras import CameraModel, Matrix
from wm_nodes.core.seeding import stream_seed
from wm_nodes.core.tool_control import check_actions, next_state
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.cameras import table_top_cameras
from wm_nodes.environments.maniskill.control import CONTROLS
from wm_nodes.environments.maniskill.scenes import make_scene, render, renew_physics
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.environments.object_reader import load_object_reader


class ManiSkillEnvironment:
    """The simulator. A state is the commanded tool in the robot base frame, see core/action_spaces.py. An episode
    follows from its seed and its actions, bit for bit: not from the episodes before it, nor from num_envs.

    end_on_success=False lets an episode go on to the step limit: a done head needs frames after success.
    pictures=False leaves them black, and what would be read off them NaN: a step is then physics alone, in a third of
    the time.
    new_physics=False leaves the physics its traces of earlier episodes; contacts then depend on them.
    """

    def __init__(
        self, task: str, config: SimulationConfig, num_envs: int = 1, seed: int = 0, *, end_on_success: bool = True,
        pictures: bool = True, new_physics: bool = True,
    ) -> None:
        self.spec = simulation_spec(task, config, num_envs)
        self._task = simulator_part(task)
        self._codes = get_task(task).parts
        self._parts = [task] * num_envs
        self._config = config
        self._seed = seed
        self._end_on_success = end_on_success
        self._pictures = pictures
        self._new_physics = new_physics
        read = config.object_state not in ("", TRUTH)
        self._reader = load_object_reader(Path(config.object_state), self.spec) if read else None
        self._control = CONTROLS[self._task.actions]
        modes = {"control_mode": self._control.control_mode, "obs_mode": self._control.obs_mode}
        self._scenes = [make_scene(self._task.scene, config, **modes) for _ in range(num_envs)]
        self._shown: list[Scene | None] = [None] * num_envs
        self._num_resets = 0
        self._images = np.zeros((num_envs, self.spec.height, self.spec.width, 3), np.uint8)
        self._states = np.zeros((num_envs, self.spec.state_dim), np.float32)
        self._truth = np.full((num_envs, self.spec.ground_truth_dim), np.nan, np.float32)
        self._first_truth = self._truth.copy()
        self._steps = np.zeros(num_envs, np.uint32)
        self._episode_ids = np.zeros(num_envs, np.uint64)
        self._ended = np.ones(num_envs, bool)

    @property
    def ground_truth(self) -> FloatArray:
        """(N, P) simulator truth of the current observation."""
        return self._truth.copy()

    @property
    def cameras(self) -> tuple[CameraModel, ...]:
        return table_top_cameras(self._config, self._hand)

    @property
    def instructions(self) -> tuple[str, ...]:
        """Of each environment's episode: where the task has many scenes, that of its scene."""
        shown = ((simulator_part(part).instruct, scene) for part, scene in zip(self._parts, self._shown, strict=True))
        return tuple(instruct(scene) if instruct and scene else self.spec.instruction for instruct, scene in shown)

    @property
    def shown_scenes(self) -> tuple[Scene | None, ...]:
        """Of each environment's episode, its scene of the catalogue."""
        return tuple(self._shown)

    def _hand(self, i: int) -> Matrix:
        """Pose (4, 4) of the link panda_hand in the robot's base frame."""
        robot = self._scenes[i].agent.robot
        pose = robot.pose.inv() * robot.links_map["panda_hand"].pose
        return np.asarray(pose.to_transformation_matrix()[0].numpy(), np.float64)

    @property
    def scene(self) -> BaseEnv:
        """The ManiSkill environment of slot 0, for the planner."""
        return self._scenes[0]

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        mask = np.ones(self.spec.num_envs, bool) if mask is None else mask
        for i in np.flatnonzero(mask):
            self._num_resets += 1
            drawn = UNSEEDED.first + stream_seed(self._seed, "reset", self._num_resets) % 2**31
            seed = drawn if seeds is None else int(seeds[i])
            self._shown[i] = scene_of(self._config.scenes, seed)
            self._parts[i] = part_of(self.spec.task, seed)
            if self._new_physics and self._shown[i] is None:  # a scene of the catalogue is built anew
                renew_physics(self._scenes[i])
            self._scenes[i].reset(seed=seed % 2**32, options={"scene": self._shown[i]})
            self._steps[i] = 0
            self._episode_ids[i] = self._num_resets
            self._ended[i] = False
            self._start(i)
        return self.current()

    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        num_envs = self.spec.num_envs
        valid = ~self._ended
        terminated, truncated = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        for i in np.flatnonzero(valid):
            target = next_state(self._states[i], actions[i], self.spec)
            tool = self._states[i, : self.spec.commanded_dim]
            tool[:] = self._control.step(self._scenes[i], tool, target[: len(tool)])
            self._steps[i] += 1
            self._observe(i)
            terminated[i] = self._end_on_success and bool(success(self.spec.task, self._truth[i]))
            truncated[i] = not terminated[i] and self._steps[i] >= self.spec.max_episode_steps
            self._ended[i] = terminated[i] or truncated[i]
        return StepResult(
            observation=self.current(), terminated=terminated, truncated=truncated,
            success_probability=success(self.spec.task, self._truth).astype(np.float32),
            uncertainty=np.zeros(num_envs, np.float32), ground_truth=self._truth.copy(), valid=valid,
        )

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        for scene in self._scenes:
            scene.close()

    def _start(self, i: int) -> None:
        self._first_truth[i] = self._task.measure(self._scenes[i], None)
        code = [part == self._parts[i] for part in self._codes]
        self._states[i] = [*self._control.state(self._scenes[i]), *(0.0 for _ in self.spec.measured), *code]
        self._observe(i)

    def _observe(self, i: int) -> None:
        scene = self._scenes[i]
        if self._pictures:
            self._images[i] = render(scene, self._config.cameras)
        self._truth[i] = self._task.measure(scene, self._first_truth[i])
        if self.spec.measured:
            self._observe_objects(i)

    def _observe_objects(self, i: int) -> None:
        """Fill the measured values of the state: what the pictures show of the truth, or what is read off them."""
        state, names = self._states[i], self.spec.state_names
        if self._reader and not self._pictures:
            state[list(self.spec.measured)] = np.nan
        elif self._reader:
            read = self._reader.fill(self._images[i : i + 1], self._states[i : i + 1])[0]
            if not self._steps[i]:
                for start, now in self._reader.starts.items():
                    read[start] = read[now]
            state[:] = read
        else:
            hidden = simulator_part(self._parts[i]).hidden_state
            for column in self.spec.measured:
                name = names[column]
                place = self._truth[i, self.spec.ground_truth_names.index(name)] - ROBOT_BASE["xyz".index(name[-1])]
                state[column] = 0.0 if name in hidden else place

    def current(self) -> Observation:
        """The observation as of the last reset or step."""
        return Observation(self._images.copy(), self._states.copy(), self._episode_ids.copy(), self._steps.copy())
