"""Data of one step, one episode and one rollout. Shapes: N environments, T time, V cameras, H W 3 image, A action,
S state, P simulator ground truth.

Time convention, used everywhere: action t moves observation t to observation t + 1; reward t, terminated t and
truncated t are computed on observation t + 1.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.specs import EnvironmentSpec

UInt8Array = NDArray[np.uint8]
FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
UInt64Array = NDArray[np.uint64]


@dataclass(frozen=True)
class Observation:
    """What N environments show.

    image: uint8 (N, H, W, 3), cameras side by side along W.
    state: float32 (N, S), units per spec (commanded tool position, m, robot base frame).
    episode_id: uint64 (N,). episode_step: uint32 (N,), 0 right after a reset.
    """

    image: UInt8Array
    state: FloatArray
    episode_id: UInt64Array
    episode_step: NDArray[np.uint32]


@dataclass(frozen=True)
class StepResult:
    """What one lock-step of N environments gives.

    terminated: bool (N,), the task is over. truncated: bool (N,), cut by the step limit; never both.
    success_probability: float32 (N,), the model's done signal on the next observation; 0 or 1 in a simulator.
    uncertainty: float32 (N,), >= 0, disagreement of the done heads; 0 in a simulator.
    ground_truth: float32 (N, P) after the step; NaN where nobody knows (imagined).
    valid: bool (N,), False where the environment was reset instead of stepped, or is waiting for a reset.
    """

    observation: Observation
    terminated: BoolArray
    truncated: BoolArray
    success_probability: FloatArray
    uncertainty: FloatArray
    ground_truth: FloatArray
    valid: BoolArray


class Environment(Protocol):
    """N environments stepped together; served by the world model, by a simulator, or by a robot.

    An environment that has ended (terminated or truncated) stays put, with valid=False, until it is reset.

    Two attributes are optional: `ground_truth`, float32 (N, P) of the current observation, and `cameras`, a sequence of
    core.cameras.CameraModel, some or all of spec.cameras, which people then see with calibration and frames.
    """

    spec: EnvironmentSpec

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        """Reset the environments in `mask` (None: all). seeds: (N,), used where mask is True."""
        ...

    def step(self, actions: FloatArray) -> StepResult:
        """Step with (N, A) actions in [-1, 1]. Raises ValueError on a wrong shape, NaN or out-of-range action."""
        ...

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        """Goal frames (N, H, W, 3) and whether each was found; None where the environment has no goals."""
        ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Episode:
    """One recorded episode of one environment, T steps.

    images: uint8 (T + 1, H, W, 3). states: float32 (T + 1, S). actions: float32 (T, A) as executed, in [-1, 1].
    ground_truth: float32 (T + 1, P), NaN where unknown. success: bool (T + 1,), the task's success at each frame.
    rewards: float32 (T,), NaN where missing. terminated, truncated: the flags of the last step.
    behaviour: who acted (expert, noisy, near_miss, policy, ...). source: EnvSpec.SOURCE_* as an int.
    """

    images: UInt8Array
    states: FloatArray
    actions: FloatArray
    ground_truth: FloatArray
    success: BoolArray
    rewards: FloatArray
    terminated: bool
    truncated: bool
    task: str
    instruction: str
    behaviour: str
    seed: int
    episode_id: int
    source: int
    policy_version: int = 0
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def num_steps(self) -> int:
        return len(self.actions)


@dataclass(frozen=True)
class Rollout:
    """T lock-steps of N environments, what the policy learner trains on. Suffix TN: (T, N, ...).

    images_TN: uint8 (T, N, H, W, 3), states_TN: float32 (T, N, S): the observations the actions answer.
    next_images_TN, next_states_TN: the observations the steps reached (truncated steps bootstrap from them).
    actions_TN: float32 (T, N, A) as executed, in [-1, 1]. logprobs_TN, values_TN: float32 (T, N).
    rewards_TN: float32 (T, N). terminated_TN, truncated_TN, valid_TN: bool (T, N).
    policy_version: the learner step whose weights acted.
    """

    images_TN: UInt8Array
    states_TN: FloatArray
    next_images_TN: UInt8Array
    next_states_TN: FloatArray
    actions_TN: FloatArray
    logprobs_TN: FloatArray
    values_TN: FloatArray
    rewards_TN: FloatArray
    terminated_TN: BoolArray
    truncated_TN: BoolArray
    valid_TN: BoolArray
    policy_version: int
