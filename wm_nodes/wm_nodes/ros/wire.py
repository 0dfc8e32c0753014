"""The wire's requests, answers and batches as numpy, so that a local and a remote caller share one path.

Shapes: N environments, A action, S state, P ground truth, H W 3 image. Stamps in ns.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from wm_nodes.core.errors import RunError
from wm_nodes.core.types import BoolArray, Ends, FloatArray, UInt8Array, UInt64Array


class PeerLost(RunError):
    """A peer did not answer before the deadline, or was restarted, or reset by another client, in between."""


class Cancelled(Exception):
    """The goal was cancelled or the node deactivated while it worked; args[0] is the reason."""


@dataclass(frozen=True)
class _Command:
    """A request, which may be sent again."""

    def equals(self, other: "_Command | None") -> bool:
        """Whether the two ask for the same."""
        return type(self) is type(other) and all(
            _same(getattr(self, field.name), getattr(other, field.name)) for field in fields(self)
        )


@dataclass(frozen=True)
class StepCommand(_Command):
    """StepBatch's request."""

    session: int
    """Of the environment, from the handshake."""
    step_id: int
    """The next one, or the last one again."""
    spec_hash: str
    """Of the spec that the caller was built for."""
    actions: FloatArray
    """(N * A,), row-major, in [-1, 1]."""
    policy_version: int = 0
    """Weights that chose the actions; 0: no numbered ones."""
    logprobs: FloatArray | None = None
    """(N,) nats; None where unknown."""
    values: FloatArray | None = None
    """(N,); None where unknown."""
    reset_mask: BoolArray | None = None
    """(N,), reset instead of stepped; None: nobody."""
    reset_seeds: UInt64Array | None = None
    """(N,); None: the environment draws them."""
    with_image: bool = True
    """Whether the answer carries the images."""


@dataclass(frozen=True)
class ResetCommand(_Command):
    """ResetBatch's request."""

    mask: BoolArray | None = None
    """(N,), who is reset; None: all."""
    seeds: UInt64Array | None = None
    """(N,); None: the environment draws them."""
    task: str = ""
    """Must be the served one; empty: not checked."""
    behaviour: str = ""
    """Label of the episode events; empty: as before."""
    with_image: bool = True
    """Whether the answer carries the images."""


@dataclass(frozen=True)
class Reply(Ends):
    """The answer to a step or a reset."""

    session: int
    """Of the environment."""
    step_id: int
    """The step answered; after a reset the last one before it, so step_id + 1 comes next in both cases."""
    stamp_ns: int
    """When the observation returned was made."""
    images: UInt8Array | None
    """(N, H, W, 3); None when not asked for."""
    states: FloatArray
    """(N, S)."""
    terminated: BoolArray
    """(N,), as in LockStep."""
    truncated: BoolArray
    """(N,), as in LockStep, or ended from outside until it is reset."""
    episode_ids: UInt64Array
    """(N,), of the observation returned."""
    success_probability: FloatArray
    """(N,), as in LockStep."""
    uncertainty: FloatArray
    """(N,), as in LockStep."""
    step_s: float = 0.0
    """Inside the environment, s."""

    def check_follows(self, before: "Reply", reset: BoolArray) -> None:
        """Raise PeerLost where another client has reset the environment since `before`. reset: (N,), by this client."""
        if (strange := (self.episode_ids != before.episode_ids) & ~reset).any():
            raise PeerLost(
                f"another client has reset environments {np.flatnonzero(strange).tolist()} within the episode; let one "
                "client at a time step an environment, and start again"
            )


@dataclass(frozen=True)
class TimedAction:
    """ActionBatch, for an environment that steps on its own clock."""

    actions: FloatArray
    """(N * A,), row-major."""
    stamp_ns: int
    """Of the observation it answers; 0: it answers none (a person's), and its age counts from arrival."""
    policy_version: int = 0
    """Weights that chose the actions; 0: no numbered ones."""
    logprobs: FloatArray | None = None
    """(N,) nats; None where unknown."""
    values: FloatArray | None = None
    """(N,); None where unknown."""


@dataclass(frozen=True)
class EpisodeNote:
    """EpisodeEvent. Constants of the message are used for kind, outcome and reason."""

    stamp_ns: int
    """Of the observation that it begins or ends with."""
    kind: int
    """KIND_*."""
    env_index: int
    """Environment, from 0."""
    episode_id: int
    """Of the episode."""
    seed: int
    """Of its reset."""
    behaviour: str
    """Who acts."""
    length: int
    """Steps made."""
    outcome: int
    """OUTCOME_*."""
    reason: int
    """REASON_*, why it ended."""
    policy_version_first: int
    """That chose its first action."""
    policy_version_last: int
    """That chose its newest action."""


def _same(value: Any, other: Any) -> bool:
    if isinstance(value, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(value, other, equal_nan=True)
    return type(value) is type(other) and bool(value == other)
