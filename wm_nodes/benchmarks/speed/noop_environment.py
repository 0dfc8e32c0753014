"""An environment that costs nothing, served over DDS: what is left is the graph's own cost."""

import numpy as np

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.tool_control import check_actions, next_state
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.environments.registry import configured_spec


class NoopEnvironment:
    """N environments of the benchmark's sizes that show noise, never end and cost nothing: the graph's own cost."""

    def __init__(self, spec: EnvironmentSpec) -> None:
        self.spec = spec
        shape = (spec.num_envs, spec.height, spec.width, 3)
        self._images = numpy_stream(0, "still").integers(0, 256, shape, np.uint8)
        middle = (np.asarray(spec.state_low) + np.asarray(spec.state_high)) / 2
        self._start = np.tile(middle.astype(np.float32), (spec.num_envs, 1))
        self._states = self._start.copy()
        self._steps = np.zeros(spec.num_envs, np.uint32)
        self._ids = np.zeros(spec.num_envs, np.uint64)
        self._num_resets = 0

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        chosen = np.ones(self.spec.num_envs, bool) if mask is None else mask
        self._states[chosen] = self._start[chosen]
        self._steps[chosen] = 0
        self._ids[chosen] = self._num_resets + 1 + np.arange(chosen.sum(), dtype=np.uint64)
        self._num_resets += int(chosen.sum())
        return self._observation()

    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        self._states = next_state(self._states, actions, self.spec)
        self._steps = self._steps + np.uint32(1)
        count = self.spec.num_envs
        no, zero = np.zeros(count, bool), np.zeros(count, np.float32)
        truth = np.full((count, self.spec.ground_truth_dim), np.nan, np.float32)
        return StepResult(self._observation(), no, no.copy(), zero, zero.copy(), truth, ~no)

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        self._steps[:] = 0

    def _observation(self) -> Observation:
        return Observation(self._images, self._states.copy(), self._ids.copy(), self._steps.copy())


def make_noop_environment(config: RunConfig, num_envs: int, seed: int) -> NoopEnvironment:
    """environment.factory of the second environment node."""
    return NoopEnvironment(configured_spec(config, num_envs))
