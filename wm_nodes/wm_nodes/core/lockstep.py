"""One lock-step of N environments: the record that is published, recorded, joined, judged and trained on.

An environment answers a step with core.types.StepResult; its node publishes a LockStep without pictures and rewards;
recording.join puts these in place. Shapes: N environments, A action, S state, P ground truth, R reward components,
H W 3 image. Stamps are ns since the epoch.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, Ends, FloatArray, UInt8Array, UInt64Array

StepKey = tuple[int, int, int]
"""Session of the environment, step id, stamp: one lock-step of all that were ever made."""


@dataclass(frozen=True, eq=False)
class Rewards:
    """What one evaluator says of one lock-step."""

    session: int
    """Of the environment that published the lock-step."""
    step_id: int
    """Of that lock-step."""
    stamp_ns: int
    """That of the lock-step."""
    total: FloatArray
    """(N,), what is maximised; NaN where valid is False."""
    dense: FloatArray
    """(N,), the weighted perceptual part."""
    sparse: FloatArray
    """(N,), the weighted success part."""
    components: FloatArray
    """(N, R), weighted."""
    component_names: tuple[str, ...]
    """R names, e.g. dense and sparse."""
    success: UInt8Array
    """(N,), 0 no, 1 yes, 2 unknown."""
    valid: BoolArray
    """(N,), False where no step was made or no reward could be given."""
    invalid_reason: str
    """Empty where every step that was made has a reward."""
    name: str
    """Of the reward model."""
    version: int
    """Changes with every change of its weights, thresholds or models."""

    @property
    def key(self) -> StepKey:
        return self.session, self.step_id, self.stamp_ns


@dataclass(frozen=True, eq=False)
class Goals:
    """The goals of all environments, published when one of them changes."""

    stamp_ns: int
    """Of the observation that the goals belong to."""
    images: UInt8Array | None
    """(N, H, W, 3); None where the environment has no goals."""
    found: BoolArray
    """(N,), False where the best frame stands in for a goal, or there is none."""
    episode_ids: UInt64Array
    """(N,), the episode that each goal belongs to."""
    session: int = 0
    """Of the environment."""


@dataclass(frozen=True, eq=False)
class LockStep(Ends):
    """The actions of N environments with the observations that they answer and reach, or the first observation."""

    session: int
    """Start of the environment's node, ns since the epoch."""
    step_id: int
    """Rises by one with every lock-step of a session; after a reset that of the last one before."""
    stamp_ns: int
    """When the observation that the actions answer was made."""
    next_stamp_ns: int
    """When the observation that the step reached was made."""
    actions: FloatArray
    """(N, A) as executed, in [-1, 1]."""
    states: FloatArray
    """(N, S) before the step."""
    next_states: FloatArray
    """(N, S) after the step."""
    logprobs: FloatArray
    """(N,) nats, of the actions; NaN where unknown."""
    values: FloatArray
    """(N,), the critic's, of the observation; NaN where unknown."""
    terminated: BoolArray
    """(N,), the task is over: done, or failed for good where truncated is set, too."""
    truncated: BoolArray
    """(N,), ended without success: by the step limit, the model's uncertainty, or a failure."""
    valid: BoolArray
    """(N,), False where the environment was reset instead of stepped, or is waiting for a reset."""
    episode_ids: UInt64Array
    """(N,), the episode of the action."""
    episode_steps: NDArray[np.uint32]
    """(N,), number of the action in its episode, from 0."""
    policy_versions: UInt64Array
    """(N,), the weights that chose the action; 0: no numbered ones."""
    success_probability: FloatArray
    """(N,), done signal on the next observation; 0 or 1 in a simulator, 0 where valid is False."""
    uncertainty: FloatArray
    """(N,), >= 0, disagreement of the done heads; 0 in a simulator."""
    ground_truth: FloatArray
    """(N, P) after the step; NaN where unknown."""
    source: int
    """EnvSpec.SOURCE_*."""
    images: UInt8Array | None = None
    """(N, H, W, 3) before the step; None where they are not joined yet, or lost."""
    next_images: UInt8Array | None = None
    """The same after the step."""
    goals: tuple[UInt8Array, BoolArray] | None = None
    """Goal images (N, H, W, 3) and whether each was found (N,); None without any."""
    rewards: Rewards | None = None
    """What the evaluator said; None where it is not joined yet, or lost."""

    @property
    def key(self) -> StepKey:
        return self.session, self.step_id, self.stamp_ns

    @property
    def is_reset(self) -> bool:
        """Whether this shows the first observation after env/reset: no action, both stamps those of that frame."""
        return self.stamp_ns == self.next_stamp_ns


@dataclass(frozen=True)
class DroppedTransitions:
    """Transitions (single environments' steps) left out of a rollout, by reason."""

    invalid: int = 0
    """Stepped, and without a reward."""
    gap: int = 0
    """Of lock-steps that did not arrive completely."""
    stale: int = 0
    """Chosen by another policy version than the one that is trained."""
