"""A tiny deterministic environment and policy: real objects for the graph, small enough for two cores."""

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.speed.noop_environment import NoopEnvironment
from wm_nodes.config.load import load_config
from wm_nodes.config.schema import PolicyConfig, RunConfig
from wm_nodes.core.cameras import CameraModel, Matrix, intrinsics, look_at
from wm_nodes.core.specs import SOURCE_REAL, SOURCE_SIMULATOR, EnvironmentSpec
from wm_nodes.core.tool_control import check_actions, next_state
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.environments.batch import EnvironmentBatch, Frame
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.reward import RewardInput, RewardResult, RuleReward
from wm_nodes.training.weights import pack_weights, unpack_weights

SIDE_PX = 16
STUCK_S = 12.0
ARM_STEPS = 3
SLOW_S = 0.3
"""One inference of make_slow_policy."""
GOAL_M = np.array([0.6, 0.0, 0.1], np.float32)


class ReachToy:
    """A dot that must reach GOAL_M within 3 cm: the image shows tool (red) and goal (green) from above."""

    def __init__(self, num_envs: int, seed: int, max_episode_steps: int = 12) -> None:
        self.spec = EnvironmentSpec(
            env_id="toy/reach", task="reach", instruction="reach the dot", source=SOURCE_SIMULATOR, num_envs=num_envs,
            height=SIDE_PX, width=SIDE_PX, cameras=("top",), action_names=("dx", "dy", "dz"),
            action_units=("m", "m", "m"), action_scale=(0.03, 0.03, 0.03), state_names=("x", "y", "z"),
            state_units=("m", "m", "m"), ground_truth_names=("tool_x", "tool_y"), control_period_s=0.1,
            max_episode_steps=max_episode_steps, state_low=(0.4, -0.2, 0.0), state_high=(0.8, 0.2, 0.3),
        )
        self._seed = seed
        self._resets = 0
        self._states = np.tile(GOAL_M, (num_envs, 1))
        self._steps = np.zeros(num_envs, np.uint32)
        self._ids = np.zeros(num_envs, np.uint64)
        self._ended = np.ones(num_envs, bool)

    @property
    def ground_truth(self) -> FloatArray:
        return self._states[:, :2].copy()

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        for i in range(self.spec.num_envs) if mask is None else np.flatnonzero(mask):
            self._resets += 1
            seed = self._seed * 100_003 + self._resets if seeds is None else int(seeds[i])
            offset = np.random.default_rng(seed).uniform(-0.12, 0.12, 3)
            self._states[i] = GOAL_M + offset.astype(np.float32) * np.array([1, 1, 0], np.float32)
            self._steps[i], self._ids[i], self._ended[i] = 0, self._resets, False
        return self._observation()

    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        valid = ~self._ended
        self._states = np.where(valid[:, None], next_state(self._states, actions, self.spec), self._states)
        self._steps = self._steps + valid.astype(np.uint32)
        near = np.linalg.norm(self._states - GOAL_M, axis=1) < 0.03
        terminated = near & valid
        truncated = valid & ~near & (self._steps >= self.spec.max_episode_steps)
        self._ended = self._ended | terminated | truncated
        return StepResult(
            self._observation(), terminated, truncated, near.astype(np.float32),
            np.zeros(self.spec.num_envs, np.float32), self.ground_truth, valid,
        )

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        self._ended[:] = True

    def _observation(self) -> Observation:
        return Observation(self._draw(), self._states.copy(), self._ids.copy(), self._steps.copy())

    def _draw(self) -> UInt8Array:
        images = np.zeros((self.spec.num_envs, SIDE_PX, SIDE_PX, 3), np.uint8)
        for color, points in ((0, self._states), (1, np.tile(GOAL_M, (self.spec.num_envs, 1)))):
            pixels: NDArray[np.int64] = ((points[:, :2] - np.array([0.4, -0.2])) / 0.4 * (SIDE_PX - 1)).astype(int)
            for i, (x, y) in enumerate(pixels.clip(0, SIDE_PX - 1)):
                images[i, x, y, color] = 255
        return images


def make_environment(config: RunConfig, num_envs: int, seed: int) -> ReachToy:
    return ReachToy(num_envs, seed)


def make_long_environment(config: RunConfig, num_envs: int, seed: int) -> ReachToy:
    """Episodes that outlast every test."""
    return ReachToy(num_envs, seed, max_episode_steps=100_000)


class Robot(ReachToy):
    """Says that it is a robot, and what it is told to do: `told VALUE` in the log."""

    def __init__(self, num_envs: int, seed: int) -> None:
        super().__init__(num_envs, seed, max_episode_steps=100_000)
        self.spec = replace(self.spec, source=SOURCE_REAL)

    def step(self, actions: FloatArray) -> StepResult:
        print(f"told {actions.flat[0]:g}", flush=True)
        return super().step(actions)

    def close(self) -> None:
        print("told nothing more", flush=True)


def make_robot(config: RunConfig, num_envs: int, seed: int) -> Robot:
    return Robot(num_envs, seed)


class VelocityArm:
    """A robot that goes on with the velocity that it was told last: `told VALUE` in the log."""

    def reset(self, seed: int) -> Frame:
        return Frame(np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8), GOAL_M, truth=(0.0, 0.0))

    def step(self, action: FloatArray) -> Frame:
        print(f"told {action[0]:g}", flush=True)
        return self.reset(0)

    def close(self) -> None: ...


class HoldingArm(VelocityArm):
    """Its action 0 is the middle of its limits, and no rest."""

    def hold(self) -> None:
        print("told to hold", flush=True)


def make_velocity_arm(config: RunConfig, num_envs: int, seed: int) -> EnvironmentBatch:
    """Of ARM_STEPS steps an episode."""
    spec = replace(ReachToy(1, seed, ARM_STEPS).spec, source=SOURCE_REAL)
    return EnvironmentBatch(spec, [VelocityArm()], seed)


def make_holding_arm(config: RunConfig, num_envs: int, seed: int) -> EnvironmentBatch:
    return EnvironmentBatch(make_velocity_arm(config, num_envs, seed).spec, [HoldingArm()], seed)


def make_own_robot(config: RunConfig, num_envs: int, seed: int) -> NoopEnvironment:
    """The robot of the configured task."""
    return NoopEnvironment(simulation_spec(config.task, config.simulation, num_envs))


def make_other_robot(config: RunConfig, num_envs: int, seed: int) -> NoopEnvironment:
    """Has as many values as the robot of the configured task, and is another one."""
    spec = simulation_spec(config.task, config.simulation, num_envs)
    other = {"action_names": ("vx", "vy", "vz"), "action_scale": (1.0, 1.0, 1.0), "control_period_s": 0.02}
    return NoopEnvironment(replace(spec, **other))


def make_environment_of_large_images(config: RunConfig, num_envs: int, seed: int) -> ReachToy:
    """Says 256 x 512 px, 384 KiB, per environment; never drawn."""
    environment = ReachToy(num_envs, seed)
    environment.spec = replace(environment.spec, height=256, width=512)
    return environment


COMPUTING_S = 6.0
"""Twice the time after which a silent node is lost."""


class TwoCameras(ReachToy):
    """ReachToy with a camera over the table and one on the tool, whose picture is the other's negative."""

    def __init__(self, num_envs: int, seed: int) -> None:
        super().__init__(num_envs, seed, max_episode_steps=100_000)
        self.spec = replace(self.spec, width=2 * SIDE_PX, cameras=("top", "hand"))
        matrix = intrinsics(SIDE_PX, SIDE_PX, fov_rad=1.0)
        top = look_at((0.6, -0.1, 0.9), (0.6, 0.0, 0.0))
        self.cameras = (
            CameraModel("top", SIDE_PX, SIDE_PX, matrix, top),
            CameraModel("hand", SIDE_PX, SIDE_PX, matrix, self._hand),
        )

    def _hand(self, env: int) -> Matrix:
        x, y, z = self._states[env].tolist()
        return look_at((x, y - 0.1, z + 0.1), (x, y, z))

    def _draw(self) -> UInt8Array:
        images = super()._draw()
        return np.concatenate([images, 255 - images], axis=2)


def make_environment_with_cameras(config: RunConfig, num_envs: int, seed: int) -> TwoCameras:
    return TwoCameras(num_envs, seed)


class LostHand(TwoCameras):
    """Cannot say where its moving camera is."""

    def _hand(self, env: int) -> Matrix:
        raise TimeoutError("no joint states")


def make_environment_with_a_lost_camera(config: RunConfig, num_envs: int, seed: int) -> LostHand:
    return LostHand(num_envs, seed)


HOMING_S = 2.6
"""One reset of make_homing_environment."""


class Homing(ReachToy):
    """Takes HOMING_S for each reset, as a robot that drives home."""

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        time.sleep(HOMING_S)
        return super().reset(mask, seeds)


def make_homing_environment(config: RunConfig, num_envs: int, seed: int) -> Homing:
    return Homing(num_envs, seed)


class Faulty(ReachToy):
    """What goes wrong once: `nan` state, `raise` in the first step, `compute` for COMPUTING_S in the 20th step, or
    `goals` that raise in the second reset."""

    def __init__(self, num_envs: int, seed: int, fault: str) -> None:
        super().__init__(num_envs, seed)
        self._fault, self._goals, self._calls = fault, 0, 0

    def step(self, actions: FloatArray) -> StepResult:
        self._calls += 1
        if self._fault == "compute":
            if self._calls == 20:
                end = time.monotonic() + COMPUTING_S
                while time.monotonic() < end:
                    np.ones(10**6).sum()
            return super().step(actions)
        fault, self._fault = self._fault, ""
        if fault == "raise":
            raise RuntimeError("broken motor")
        result = super().step(actions)
        if fault == "nan":
            result.observation.state[0] = np.nan
        return result

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        self._goals += 1
        if self._fault == "goals" and self._goals == 2:
            raise ZeroDivisionError("no goal")
        return None


def make_nan_environment(config: RunConfig, num_envs: int, seed: int) -> Faulty:
    return Faulty(num_envs, seed, "nan")


def make_failing_environment(config: RunConfig, num_envs: int, seed: int) -> Faulty:
    return Faulty(num_envs, seed, "raise")


def make_computing_environment(config: RunConfig, num_envs: int, seed: int) -> Faulty:
    return Faulty(num_envs, seed, "compute")


def make_environment_with_bad_goals(config: RunConfig, num_envs: int, seed: int) -> Faulty:
    """Its second reset raises where no request's answer is at stake, so in a callback."""
    return Faulty(num_envs, seed, "goals")


def make_policy(config: RunConfig) -> ImagePolicy:
    def encode(images: torch.Tensor) -> torch.Tensor:
        return images.float().reshape(len(images), -1)[:, ::3] / 255

    encoder = ImageEncoder(encode, SIDE_PX * SIDE_PX, sha256="toy")
    small = config.policy.model_copy(update={"width": 16, "depth": 1, "projection": 8})
    assert isinstance(small, PolicyConfig)
    torch.set_num_threads(1)
    return ImagePolicy(encoder, 3, 3, small, seed=config.seed)


def assert_trained_in_one_process(
    file: Path, updates: int, tolerance: float = 0.0, settings: Mapping[str, Any] | None = None
) -> None:
    """Assert that a weights file holds what policy_rl/train.py gives; bit for bit with tolerance 0.

    settings: changes of the preset smoke.
    """
    config = load_config("smoke", {"ppo.num_envs": 4, "ppo.updates": updates, **(settings or {})})
    policy, environment = make_policy(config), make_environment(config, num_envs=4, seed=0)
    trained = list(train_policy(policy, environment, RuleReward(config.reward.sparse_weight), config))
    assert trained[-1][1].grad_norm > 1e-2, "the last update learned nothing"
    found, _ = unpack_weights(file.read_bytes())
    expected, _ = unpack_weights(pack_weights(policy).data)
    for name, tensor in expected.items():
        np.testing.assert_allclose(found[name].numpy(), tensor.numpy(), rtol=0, atol=tolerance, err_msg=name)


def make_slow_policy(config: RunConfig) -> ImagePolicy:
    """Takes SLOW_S for every inference."""
    policy = make_policy(config)
    act = policy.act

    def act_slowly(*arguments: Any, **more: Any) -> Any:
        time.sleep(SLOW_S)
        return act(*arguments, **more)

    policy.act = act_slowly  # type: ignore[method-assign]
    return policy


def make_stuck_learner(policy: ImagePolicy, config: RunConfig) -> Any:
    """A learner whose update hears nobody for STUCK_S, as on a crowded machine."""
    learner = PpoLearner(policy, config.ppo, seed=config.seed)

    def update(rollout: Any, **_more: Any) -> Any:
        print("stuck", flush=True)
        time.sleep(STUCK_S)
        raise RuntimeError("nobody waits for this")

    learner.update = update  # type: ignore[method-assign]
    return learner


class FailingReward(RuleReward):
    """Raises at every second step, and then gives one reward too few, in turn."""

    def __init__(self) -> None:
        super().__init__(1.0)
        self._calls = 0

    def evaluate(self, step: RewardInput) -> RewardResult:
        self._calls += 1
        if self._calls % 2:
            raise KeyError("no such part")
        result = super().evaluate(step)
        return replace(result, total=result.total[1:])


def make_failing_reward(config: RunConfig) -> FailingReward:
    return FailingReward()
