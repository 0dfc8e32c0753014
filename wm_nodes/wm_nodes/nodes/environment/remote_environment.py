"""An environment node seen through the Environment interface, so that in-process code steps it over DDS unchanged.

Shapes: N environments, A action.
"""

import numpy as np

from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.ros.clients import Check, EnvironmentClient
from wm_nodes.ros.wire import Reply, ResetCommand, StepCommand


class RemoteEnvironment:
    """Implements Environment for use in a worker thread.

    Args:
        client: the environment; a handshake is made here.
        check: raises Cancelled when the caller must stop.
        behaviour: label of the episode events.
        policy_version: carried by the transitions.

    Raises:
        PeerLost, WireError: from the constructor, reset and step; see ros.clients. PeerLost, too, where another client
            has reset the environment since the last call.
    """

    def __init__(
        self, client: EnvironmentClient, check: Check, *, timeout_s: float, behaviour: str = "", policy_version: int = 0
    ) -> None:
        self.spec = client.handshake(timeout_s, check)
        self._client, self._check = client, check
        self._behaviour, self._policy_version = behaviour, policy_version
        self._steps = np.zeros(self.spec.num_envs, np.uint32)
        self._ended = np.ones(self.spec.num_envs, bool)
        self._last: Reply | None = None

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        reply = self._client.reset(ResetCommand(mask, seeds, behaviour=self._behaviour), self._check)
        reset = np.ones(self.spec.num_envs, bool) if mask is None else mask
        reply.check_follows(self._last or reply, reset)
        self._last = reply
        self._steps = np.where(reset, 0, self._steps).astype(np.uint32)
        self._ended = self._ended & ~reset
        return self._observation(self._last)

    def step(self, actions: FloatArray) -> StepResult:
        if self._last is None:
            raise ValueError("reset() must come before step()")
        self._check()  # a client that is answered at once never asks it
        reply = self._client.step(
            StepCommand(
                session=self._last.session, step_id=self._last.step_id + 1, spec_hash=self.spec.spec_hash,
                actions=np.ascontiguousarray(actions, np.float32).reshape(-1), policy_version=self._policy_version,
            ),
            self._check,
        )
        reply.check_follows(self._last, np.zeros_like(self._ended))
        valid = ~self._ended
        self._steps = self._steps + valid.astype(np.uint32)
        self._ended = self._ended | reply.ended
        self._last = reply
        unknown = np.full((self.spec.num_envs, self.spec.ground_truth_dim), np.nan, np.float32)
        return StepResult(
            self._observation(reply), reply.terminated, reply.truncated, reply.success_probability,
            reply.uncertainty, unknown, valid,
        )

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        self._last = None

    def _observation(self, reply: Reply) -> Observation:
        assert reply.images is not None
        return Observation(reply.images, reply.states, reply.episode_ids, self._steps.copy())
