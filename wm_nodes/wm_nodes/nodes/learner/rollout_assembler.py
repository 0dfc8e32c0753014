"""Joins what the graph published about a rollout: transitions, images by exact stamp, rewards by (session, step id).

Shapes: T lock-steps, N environments, H W 3 image.
"""

import threading
from collections import OrderedDict

import numpy as np

from wm_nodes.core.types import Rollout, UInt8Array
from wm_nodes.policy_rl.training_run import DroppedTransitions
from wm_nodes.ros.wire import Rewards, Transition


class ImageCache:
    """Images (N, H, W, 3) by stamp, at most `capacity` of them; the oldest go first."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._images: OrderedDict[int, UInt8Array] = OrderedDict()

    def put(self, stamp_ns: int, images: UInt8Array) -> None:
        self._images[stamp_ns] = images
        while len(self._images) > self._capacity:
            self._images.popitem(last=False)

    def get(self, stamp_ns: int) -> UInt8Array | None:
        return self._images.get(stamp_ns)

    def items(self) -> list[tuple[int, UInt8Array]]:
        return list(self._images.items())

    def drop_before(self, stamp_ns: int) -> None:
        while self._images and next(iter(self._images)) < stamp_ns:
            self._images.popitem(last=False)

    def clear(self) -> None:
        self._images.clear()

    def __len__(self) -> int:
        return len(self._images)


class RolloutAssembler:
    """Collects one rollout at a time. Thread-safe: callbacks put, the worker waits and takes.

    session: of the environment; a new one makes everything collected before worthless.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.session = 0
        self._images: dict[int, UInt8Array] = {}
        self._transitions: dict[int, Transition] = {}
        self._rewards: dict[int, Rewards] = {}
        self._collecting = False

    @property
    def collecting(self) -> bool:
        return self._collecting

    def begin(self) -> None:
        """Forget everything and collect from now on."""
        with self._changed:
            self._clear()
            self._collecting = True

    def end(self) -> None:
        """Collect nothing until begin()."""
        with self._changed:
            self._clear()
            self._collecting = False

    def enter_session(self, session: int) -> None:
        """The environment was (re)started: its step ids start again."""
        with self._changed:
            if session != self.session:
                self.session = session
                self._clear()

    def put_image(self, stamp_ns: int, images: UInt8Array) -> None:
        with self._changed:
            if self._collecting:
                self._images[stamp_ns] = images
                self._changed.notify_all()

    def put_transition(self, transition: Transition) -> None:
        self.enter_session(transition.session)
        with self._changed:
            if self._collecting and not transition.is_reset:
                self._transitions[transition.step_id] = transition
                self._changed.notify_all()

    def put_rewards(self, rewards: Rewards) -> None:
        with self._changed:
            if self._collecting and rewards.transition_session == self.session:
                self._rewards[rewards.step_id] = rewards
                self._changed.notify_all()

    def wait(self, seconds: float) -> None:
        """Return after the next put, or after `seconds`."""
        with self._changed:
            self._changed.wait(seconds)

    def missing(self, session: int, first: int, last: int) -> list[int]:
        """Return the step ids first..last (inclusive) that lack their transition, an image or their rewards."""
        with self._changed:
            if session != self.session:
                return list(range(first, last + 1))
            return [step_id for step_id in range(first, last + 1) if not self._complete(step_id)]

    def take(self, first: int, last: int, policy_version: int) -> tuple[Rollout, DroppedTransitions]:
        """Return the rollout of step ids first..last. Incomplete steps are invalid and counted as gaps.

        Raises:
            ValueError: not a single step is complete.
        """
        with self._changed:
            steps = [step_id if self._complete(step_id) else None for step_id in range(first, last + 1)]
            known = [step_id for step_id in steps if step_id is not None]
            if not known:
                raise ValueError(f"none of the lock-steps {first}..{last} arrived completely")
            template = self._transitions[known[0]]
            num_envs = len(template.valid)
            shape = self._images[template.stamp_ns].shape
            rows = len(steps)
            images = np.zeros((rows, *shape), np.uint8)
            next_images = np.zeros((rows, *shape), np.uint8)
            floats = {name: np.zeros((rows, num_envs), np.float32) for name in ("logprobs", "values", "rewards")}
            states = np.zeros((rows, *template.states.shape), np.float32)
            next_states = np.zeros_like(states)
            actions = np.zeros((rows, *template.actions.shape), np.float32)
            flags = {name: np.zeros((rows, num_envs), bool) for name in ("terminated", "truncated", "valid")}
            invalid = stale = 0
            for row, step_id in enumerate(steps):
                if step_id is None:
                    continue
                step = self._transitions[step_id]
                images[row], next_images[row] = self._images[step.stamp_ns], self._images[step.next_stamp_ns]
                states[row], next_states[row], actions[row] = step.states, step.next_states, step.actions
                floats["logprobs"][row], floats["values"][row] = step.logprobs, step.values
                flags["terminated"][row], flags["truncated"][row] = step.terminated, step.truncated
                rewards = self._rewards.get(step_id)
                judged = np.zeros(num_envs, bool) if rewards is None else rewards.valid
                floats["rewards"][row] = np.nan if rewards is None else rewards.total
                fresh = step.policy_versions == policy_version
                flags["valid"][row] = step.valid & judged & fresh
                stale += int((step.valid & ~fresh).sum())
                invalid += int((step.valid & fresh & ~judged).sum())
        rollout = Rollout(
            images_TN=images, states_TN=states, next_images_TN=next_images, next_states_TN=next_states,
            actions_TN=actions, logprobs_TN=floats["logprobs"], values_TN=floats["values"],
            rewards_TN=floats["rewards"], terminated_TN=flags["terminated"], truncated_TN=flags["truncated"],
            valid_TN=flags["valid"], policy_version=policy_version,
        )
        return rollout, DroppedTransitions(invalid=invalid, gap=(rows - len(known)) * num_envs, stale=stale)

    def _complete(self, step_id: int) -> bool:
        step = self._transitions.get(step_id)
        if step is None or step.stamp_ns not in self._images or step.next_stamp_ns not in self._images:
            return False
        return step_id in self._rewards or not step.valid.any()

    def _clear(self) -> None:
        self._images.clear()
        self._transitions.clear()
        self._rewards.clear()
