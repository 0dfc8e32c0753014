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
    """What N environments show."""

    image: UInt8Array
    """uint8 (N, H, W, 3), cameras side by side along W."""
    state: FloatArray
    """float32 (N, S), units per spec (commanded tool position, m, robot base frame)."""
    episode_id: UInt64Array
    """uint64 (N,)."""
    episode_step: NDArray[np.uint32]
    """uint32 (N,), 0 right after a reset."""


class Ends:
    """What the two flags of a step say together, (N,) each."""

    terminated: BoolArray
    truncated: BoolArray

    @property
    def success(self) -> BoolArray:
        """The task is done."""
        return self.terminated & ~self.truncated

    @property
    def ended(self) -> BoolArray:
        """The episode is over, for whichever reason."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class StepResult(Ends):
    """What one lock-step of N environments gives."""

    observation: Observation
    """What the environments show after it."""
    terminated: BoolArray
    """bool (N,), the task is over: done, or failed for good where truncated is set, too."""
    truncated: BoolArray
    """bool (N,), ended without success."""
    success_probability: FloatArray
    """float32 (N,), the model's done signal on the next observation; 0 or 1 in a simulator."""
    uncertainty: FloatArray
    """float32 (N,), >= 0, disagreement of the done heads; 0 in a simulator."""
    ground_truth: FloatArray
    """float32 (N, P) after the step; NaN where nobody knows (imagined)."""
    valid: BoolArray
    """bool (N,), False where the environment was reset instead of stepped, or is waiting for a reset."""


class Environment(Protocol):
    """N environments stepped together; served by the world model, by a simulator, or by a robot.

    An environment that has ended (terminated or truncated) stays put, with valid=False, until it is reset.

    Two attributes are optional: `ground_truth`, float32 (N, P) of the current observation, and `cameras`, a sequence of
    core.cameras.CameraModel, some or all of spec.cameras, which people then see with calibration and frames. So is a
    method of robots, `hold() -> None`: every one stays where it is, also after its episode. Without it action 0 is
    stepped instead, see environments/batch.py.
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


RECOVERY, TAKEN_OVER = "recovery", "taken_over"
"""Episode.behaviour of an episode that a policy began and an expert ended; Episode.extra[TAKEN_OVER] is the expert's
first step.
"""

TRY = "try"
"""Episode.extra[TRY]: number, within its bag, of the try that the episode was cut out of; others may be of the same."""


@dataclass(frozen=True)
class Episode:
    """One recorded episode of one environment, T steps."""

    images: UInt8Array
    """uint8 (T + 1, H, W, 3)."""
    states: FloatArray
    """float32 (T + 1, S)."""
    actions: FloatArray
    """float32 (T, A) as executed, in [-1, 1]."""
    ground_truth: FloatArray
    """float32 (T + 1, P), NaN where unknown."""
    success: BoolArray
    """bool (T + 1,), the task's success at each frame."""
    rewards: FloatArray
    """float32 (T,), NaN where missing."""
    terminated: bool
    """Flag of the last step: the task is over, as in StepResult."""
    truncated: bool
    """Flag of the last step: ended without success."""
    task: str
    """Name of the task."""
    instruction: str
    """The task in natural language."""
    behaviour: str
    """Who acted (expert, noisy, near_miss, policy, ...)."""
    seed: int
    """Of the reset."""
    episode_id: int
    """As in Observation."""
    source: int
    """EnvSpec.SOURCE_* as an int."""
    policy_version: int = 0
    """The learner step whose weights acted."""
    extra: Mapping[str, Any] = field(default_factory=dict)
    """What else is recorded of it, by name; must fit into JSON."""

    @property
    def num_steps(self) -> int:
        return len(self.actions)


@dataclass(frozen=True)
class Rollout:
    """T lock-steps of N environments, what the policy learner trains on. Suffix TN: (T, N, ...)."""

    images_TN: UInt8Array
    """uint8 (T, N, H, W, 3), of the observations that the actions answer."""
    states_TN: FloatArray
    """float32 (T, N, S), of the same observations."""
    next_images_TN: UInt8Array
    """uint8 (T, N, H, W, 3), of the observations that the steps reached (truncated steps bootstrap from them)."""
    next_states_TN: FloatArray
    """float32 (T, N, S), of the same observations."""
    actions_TN: FloatArray
    """float32 (T, N, A) as executed, in [-1, 1]."""
    logprobs_TN: FloatArray
    """float32 (T, N), of the actions, nats."""
    values_TN: FloatArray
    """float32 (T, N), of the observations that the actions answer."""
    rewards_TN: FloatArray
    """float32 (T, N)."""
    terminated_TN: BoolArray
    """bool (T, N), as in StepResult."""
    truncated_TN: BoolArray
    """bool (T, N), as in StepResult."""
    valid_TN: BoolArray
    """bool (T, N), False where the step is skipped in training."""
    policy_version: int
    """The learner step whose weights acted."""
