"""The wire's requests, answers and batches as numpy, so that a local and a remote caller share one path.

Shapes: N environments, A action, S state, P ground truth, H W 3 image. Stamps in ns.
"""

from dataclasses import dataclass

from wm_nodes.core.errors import RunError
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array, UInt64Array


class PeerLost(RunError):
    """A peer did not answer before the deadline, or was restarted in between."""


class Cancelled(Exception):
    """The goal was cancelled or the node deactivated while it worked; args[0] is the reason."""


@dataclass(frozen=True)
class StepCommand:
    """StepBatch's request. actions: (N * A,), row-major. Optional arrays: (N,) or None."""

    session: int
    step_id: int
    spec_hash: str
    actions: FloatArray
    policy_version: int = 0
    logprobs: FloatArray | None = None
    values: FloatArray | None = None
    reset_mask: BoolArray | None = None
    reset_seeds: UInt64Array | None = None
    with_image: bool = True


@dataclass(frozen=True)
class ResetCommand:
    """ResetBatch's request. Optional arrays: (N,) or None."""

    mask: BoolArray | None = None
    seeds: UInt64Array | None = None
    task: str = ""
    behaviour: str = ""
    with_image: bool = True


@dataclass(frozen=True)
class Reply:
    """The answer to a step or a reset. images: (N, H, W, 3), or None when not asked for. step_s: s inside."""

    session: int
    step_id: int
    """The step answered; after a reset the last one before it, so step_id + 1 comes next in both cases."""
    stamp_ns: int
    images: UInt8Array | None
    states: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    episode_ids: UInt64Array
    success_probability: FloatArray
    uncertainty: FloatArray
    step_s: float = 0.0


@dataclass(frozen=True)
class TimedAction:
    """ActionBatch, for an environment that steps on its own clock. actions: (N * A,). logprobs, values: (N,) or None.

    stamp_ns: of the observation it answers; 0: it answers none (a person's), and its age counts from arrival.
    """

    actions: FloatArray
    stamp_ns: int
    policy_version: int = 0
    logprobs: FloatArray | None = None
    values: FloatArray | None = None


@dataclass(frozen=True)
class EpisodeNote:
    """EpisodeEvent. Constants of the message are used for kind, outcome and reason."""

    stamp_ns: int
    kind: int
    env_index: int
    episode_id: int
    seed: int
    behaviour: str
    length: int
    outcome: int
    reason: int
    policy_version_first: int
    policy_version_last: int
