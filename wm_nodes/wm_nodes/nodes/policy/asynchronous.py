"""The policy in asynchronous mode: acts on the newest observation, in a thread of its own; older ones are skipped.

Shapes: N environments, S state, H W 3 image.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from sensor_msgs.msg import Image

from wm_msgs.msg import ErrorCode, TransitionBatch
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.nodes.policy.weights import PolicyHolder
from wm_nodes.policy_rl.image_policy import PolicyOutput
from wm_nodes.recording.messages import floats, images_of, time_ns
from wm_nodes.ros import diagnostics
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.sequence_numbers import MAX_NUMBER

CAPACITY = 8


@dataclass(frozen=True)
class SyncedObservation:
    """One observation as the topics brought it."""

    stamp_ns: int
    """When it was made."""
    step_id: int
    """Of the next step."""
    images: UInt8Array
    """(N, H, W, 3)."""
    states: FloatArray
    """(N, S)."""


class AsynchronousPolicy:
    """Joins images and states by exact stamp and lets the policy act on the newest pair.

    spec: of the environment, once it is known; nothing is done before.

    Args:
        node: listens for it; its parameter `deterministic` switches the action noise off.
        publish: called with (stamp_ns, step_id, output, policy version, seconds of inference).
        hold: publishes that the environment is to hold.
        stopped: the emergency stop is set already.
    """

    def __init__(
        self, node: ManagedNode, holder: PolicyHolder, publish: Callable[[int, int, PolicyOutput, int, float], None],
        hold: Callable[[], None], *, stopped: bool = False,
    ) -> None:
        self._node, self._holder, self._publish, self._hold = node, holder, publish, hold
        self._outgoing = threading.Lock()
        self._stopped, self._stops = stopped, 0
        self.spec: EnvironmentSpec | None = None
        self.refused_session: int | None = None
        """Of the environment that sent another robot's spec; nothing is done on its states."""
        self._changed = threading.Condition()
        self._images: dict[int, UInt8Array] = {}
        self._states: dict[int, tuple[int, FloatArray]] = {}
        self._next: SyncedObservation | None = None
        self._thread: threading.Thread | None = None
        self._running = False
        self.skipped = 0
        """Observations that a newer one replaced before they were acted upon."""
        node.listen("env/image", self._on_image)
        node.listen("env/transition", self._on_transition)

    def start(self) -> None:
        self._running = True
        self._thread = threading.Thread(target=self._run, name="asynchronous policy")
        self._thread.start()

    def stop(self) -> None:
        """End the thread; what was seen is forgotten."""
        with self._changed:
            self._running, self._next = False, None
            self._changed.notify_all()
        with self._outgoing:
            self._stops += 1  # an inference that outlasts the join publishes nothing
        if self._thread is not None:
            self._thread.join(5.0)
            self._thread = None
        self._images.clear()
        self._states.clear()

    def obey_stop(self, stopped: bool) -> None:
        """Publish a hold at once and no action from now on, also not the one that is being computed; False: go on."""
        with self._outgoing:
            if stopped and not self._stopped:
                self._stops += 1
                self._hold()
            self._stopped = stopped

    def _on_image(self, message: Image) -> None:
        if self.spec is None:
            return
        images, stamp_ns = images_of(message, self.spec), time_ns(message.header.stamp)
        with self._changed:
            _keep(self._images, stamp_ns, images)
            self._join(stamp_ns)

    def _on_transition(self, message: TransitionBatch) -> None:
        if self.spec is None or message.session == self.refused_session:
            return
        shape = (self.spec.num_envs, self.spec.state_dim)
        states = floats(message.next_state, shape, "next_state")
        if message.step_id == MAX_NUMBER:
            raise WireError(ErrorCode.OUT_OF_RANGE, f"no step comes after step_id {message.step_id}; count from 0")
        stamp_ns = time_ns(message.next_stamp)
        with self._changed:
            _keep(self._states, stamp_ns, (message.step_id + 1, states))
            self._join(stamp_ns)

    def _join(self, stamp_ns: int) -> None:
        images, states = self._images.get(stamp_ns), self._states.get(stamp_ns)
        if images is None or states is None:
            return
        self.skipped += self._next is not None
        self._next = SyncedObservation(stamp_ns, states[0], images, states[1])
        self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._running and self._next is None:
                    self._changed.wait()
                if not self._running:
                    return
                observation, self._next = self._next, None
            assert observation is not None
            try:
                self._act(observation)
            except Exception as error:
                text = f"cannot act on an observation: {type(error).__name__}: {error}"
                self._node.get_logger().error(text, throttle_duration_sec=1.0)
                self._node.diagnostics.count("failed_flights", level=diagnostics.ERROR, text=text)

    def _act(self, observation: SyncedObservation) -> None:
        with self._outgoing:
            stopped, stops = self._stopped, self._stops
        if stopped:
            return
        noise = None
        if not self._node.param("deterministic"):
            shape = (len(observation.states), self._holder.policy.action_dim)
            noise = np.random.default_rng().standard_normal(shape, np.float32)
        began = time.perf_counter()
        output, version = self._holder.act(observation.images, observation.states, noise)
        infer_s = time.perf_counter() - began
        self._node.diagnostics.latency("infer", infer_s)
        with self._outgoing:
            if stops == self._stops:
                self._publish(observation.stamp_ns, observation.step_id, output, version, infer_s)


def _keep(kept: dict[int, Any], stamp_ns: int, value: object) -> None:
    """Put a value among the newest CAPACITY."""
    kept[stamp_ns] = value
    while len(kept) > CAPACITY:
        del kept[next(iter(kept))]
