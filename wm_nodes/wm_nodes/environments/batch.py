"""One environment, a robot or a simulator, as a batch of them: what core.types.Environment asks beyond it. Shapes: N
copies, A action, S state, H W 3 image."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from wm_nodes.core.seeding import stream_seed
from wm_nodes.core.specs import SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.tool_control import check_actions, hold_actions
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array


class Frame(NamedTuple):
    """What one environment shows after a reset or a step."""

    image: UInt8Array
    """uint8 (H, W, 3), cameras side by side."""
    state: FloatArray
    """float32 (S,), units of the spec."""
    success: bool = False
    """Whether the task is done, which terminates the episode."""
    over: bool = False
    """Whether the episode is cut without success, as by a time limit: what would follow still counts in training."""
    failed: bool = False
    """Whether the task has failed for good, as after a fall: nothing that could follow is worth anything."""
    truth: Sequence[float] = ()
    """The spec's ground truth; NaN for what is unknown."""


class SingleEnvironment(Protocol):
    """What has to be written for an environment.

    A robot may also have `hold() -> None`: stay where it is. It is called at an emergency stop, at deactivation, in a
    wait for credit, after a second without a step, and when an episode or a rollout ends. Without it the robot is
    stepped with action 0 instead, which must then mean to stay: it does not where commands are absolute, or 0 is the
    middle of limits such as 0 to 0.08 m.
    """

    def reset(self, seed: int) -> Frame:
        """Begin an episode. seed: decides how, where that can be had; a real robot may leave it aside."""
        ...

    def step(self, action: FloatArray) -> Frame:
        """Act. action: float32 (A,) in [-1, 1]."""
        ...

    def close(self) -> None: ...


class EnvironmentBatch:
    """Copies that are stepped one after the other in this process; their episodes end with success, where a copy says
    so, and after spec.max_episode_steps. A robot then holds until it is reset.

    Args:
        spec: of one of them.
        seed: root seed of resets without a given seed.
    """

    def __init__(self, spec: EnvironmentSpec, copies: Sequence[SingleEnvironment], seed: int) -> None:
        count = len(copies)
        self.spec = replace(spec, num_envs=count)
        self._copies, self._seed, self._resets = copies, seed, 0
        self._images = np.zeros((count, spec.height, spec.width, 3), np.uint8)
        self._states = np.zeros((count, spec.state_dim), np.float32)
        self.ground_truth = np.full((count, spec.ground_truth_dim), np.nan, np.float32)
        self._ids, self._steps = np.zeros(count, np.uint64), np.zeros(count, np.uint32)
        self._ended = np.ones(count, bool)

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        for env in range(len(self._copies)) if mask is None else np.flatnonzero(mask):
            self._resets += 1
            seed = stream_seed(self._seed, "reset", self._resets) if seeds is None else int(seeds[env])
            self._show(env, self._copies[env].reset(seed))
            self._ids[env], self._steps[env], self._ended[env] = self._resets, 0, False
        return self._observation()

    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        valid, (success, over, failed) = ~self._ended, np.zeros((3, len(self._copies)), bool)
        for env in np.flatnonzero(valid):
            frame = self._copies[env].step(actions[env])
            self._show(env, frame)
            success[env], over[env], failed[env] = frame.success, frame.over, frame.failed
        self._steps += valid.astype(np.uint32)
        failed &= ~success
        truncated = valid & ~success & (over | failed | (self._steps >= self.spec.max_episode_steps))
        self._ended = self._ended | success | truncated
        if self.spec.source == SOURCE_REAL:
            self._hold(np.flatnonzero(success | truncated))
        count = len(self._copies)
        return StepResult(
            self._observation(), success | failed, truncated, success.astype(np.float32), np.zeros(count, np.float32),
            self.ground_truth.copy(), valid,
        )

    def hold(self) -> None:
        """Have every copy stay where it is, also one whose episode has ended; what it shows then is left aside."""
        self._hold(range(len(self._copies)))

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        for copy in self._copies:
            copy.close()

    def _hold(self, envs: Iterable[int]) -> None:
        actions = hold_actions(self._states, self.spec)
        for env in envs:
            if hold := getattr(self._copies[env], "hold", None):
                hold()
            else:
                self._copies[env].step(actions[env])

    def _show(self, env: int, frame: Frame) -> None:
        for name, value, kept in (
            ("image", frame.image, self._images[env]), ("state", frame.state, self._states[env]),
            ("truth", frame.truth, self.ground_truth[env]),
        ):
            if (shape := np.shape(value)) != kept.shape:
                raise ValueError(f"{self.spec.env_id} shows {name} of shape {shape}, and its spec says {kept.shape}")
            kept[...] = value

    def _observation(self) -> Observation:
        return Observation(self._images.copy(), self._states.copy(), self._ids.copy(), self._steps.copy())
