"""Join what the graph published about each lock-step: transition, both images (by exact stamp), reward (by session,
step_id and stamp). Streaming: a window of messages is in memory, never the bag. Shapes: N environments, H W image."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array, UInt64Array
from wm_nodes.recording import topics
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.messages import KIND_END, mosaic_of, stamp_ns

MAX_LAG = 64
"""Lock-steps that may pass before an image or reward counts as missing."""


@dataclass(frozen=True)
class RecordedReward:
    """One RewardBatch. total, dense, sparse: float32 (N,). components: float32 (N, R). success, valid: (N,)."""

    total: FloatArray
    dense: FloatArray
    sparse: FloatArray
    components: FloatArray
    component_names: tuple[str, ...]
    success: UInt8Array
    valid: BoolArray
    reward_name: str
    reward_version: int


@dataclass(frozen=True)
class RecordedStep:
    """One lock-step as published; fields as in wm_msgs/TransitionBatch, first axis N.

    images, next_images: uint8 (N, H, W, 3), None where missing. goals: uint8 (N, H, W, 3) and found (N,), or None.
    ground_truth: float32 (N, P), NaN where unknown.
    is_reset: the observation after env/reset, not a step.
    """

    session: int
    seq: int
    step_id: int
    stamp_ns: int
    next_stamp_ns: int
    images: UInt8Array | None
    next_images: UInt8Array | None
    goals: tuple[UInt8Array, BoolArray] | None
    actions: FloatArray
    states: FloatArray
    next_states: FloatArray
    logprobs: FloatArray
    values: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    valid: BoolArray
    episode_id: UInt64Array
    episode_step: NDArray[np.uint32]
    policy_version: UInt64Array
    success_probability: FloatArray
    uncertainty: FloatArray
    ground_truth: FloatArray
    source: int
    reward: RecordedReward | None

    @property
    def is_reset(self) -> bool:
        return self.stamp_ns == self.next_stamp_ns


class LockSteps:
    """Iterate over the lock-steps of one environment in a bag.

    events: (session, env_index, episode_id) to the newest EpisodeEvent read so far; the reader removes what it used.
    lost: sequence numbers missing on env/transition so far.

    Args:
        namespace: of the environment; None takes the only one.
        reward_name: which evaluator's rewards to join; None takes the first that answered.
    """

    def __init__(self, bag: Bag, *, namespace: str | None = None, reward_name: str | None = None) -> None:
        self.bag = bag
        self.namespace = bag.namespace(namespace)
        self.spec, self.tiles = bag.spec(self.namespace)
        self.events: dict[tuple[int, int, int], Any] = {}
        self.lost = 0
        self._reward_name = reward_name
        self._names = {topics.absolute(self.namespace, topic): topic for topic in topics.ALL_TOPICS}
        bag.check_types(self._names)
        self._counts = {topic: bag.count(name) for name, topic in self._names.items()}
        if not self._counts[topics.IMAGES]:
            raise BagError(
                f"bag {bag.path} has no images on {topics.absolute(self.namespace, topics.IMAGES)}; "
                "record that topic to train from the bag"
            )
        self._images: dict[int, UInt8Array] = {}
        self._received: dict[int, int] = {}
        self._last_transition_ns = 0
        self._rewards: dict[tuple[int, int, int], RecordedReward] = {}
        self._goals: dict[int, tuple[UInt8Array, bool]] = {}
        self._last_seq: tuple[int, int] | None = None

    @property
    def has_events(self) -> bool:
        return self._counts[topics.EPISODE] > 0

    def __iter__(self) -> Iterator[RecordedStep]:
        pending: deque[Any] = deque()
        wanted = (topics.IMAGES, topics.TRANSITION, topics.REWARD, topics.EPISODE, topics.GOAL)
        names = [name for name, topic in self._names.items() if topic in wanted]
        for name, time_ns, data in self.bag.messages(names):
            topic = self._names[name]
            message = self.bag.decode(data, topic.msgtype)
            if topic is topics.TRANSITION:
                if self._last_seq is not None and self._last_seq[0] != message.session:
                    while pending:
                        yield self._join_step(pending.popleft())
                    self._forget_images(time_ns)
                self._check_transition(message)
                self._last_transition_ns = time_ns
                pending.append(message)
            elif topic is topics.IMAGES:
                stamp = stamp_ns(message.header.stamp)
                self._images[stamp], self._received[stamp] = self._untile(message), time_ns
            elif topic is topics.REWARD:
                self._keep_reward(message)
            elif topic is topics.GOAL:
                self._keep_goals(message)
            else:
                self._keep_event(message)
            while pending and (len(pending) > MAX_LAG or self._is_complete(pending[0])):
                yield self._join_step(pending.popleft())
        while pending:
            yield self._join_step(pending.popleft())

    def _untile(self, message: Any) -> UInt8Array:
        mosaic = mosaic_of(message, self.spec, self.tiles, where=str(self.bag.path))
        return self.tiles.untile(mosaic, self.spec.num_envs)

    def _check_transition(self, message: Any) -> None:
        spec, where = self.spec, f"transition seq {message.seq} in {self.bag.path}"
        if message.num_envs != spec.num_envs:
            raise BagError(f"{where} has {message.num_envs} environments, env/spec says {spec.num_envs}")
        sizes = {"action": spec.action_dim, "state": spec.state_dim, "next_state": spec.state_dim, "valid": 1}
        for name, size in sizes.items():
            length = len(getattr(message, name))
            if length != size * spec.num_envs:
                raise BagError(
                    f"{where} has {length} values in {name} instead of {spec.num_envs} x {size}; the bag's env/spec "
                    "describes another robot"
                )
        if self._last_seq is not None and self._last_seq[0] == message.session:
            self.lost += max(0, int(message.seq) - self._last_seq[1] - 1)
        self._last_seq = int(message.session), int(message.seq)

    def _keep_reward(self, message: Any) -> None:
        if self._reward_name is not None and message.reward_name != self._reward_name:
            return
        key = (int(message.transition_session), int(message.step_id), stamp_ns(message.header.stamp))
        num_envs = int(message.num_envs)
        reward = RecordedReward(
            total=message.total, dense=message.dense, sparse=message.sparse,
            components=message.components.reshape(num_envs, -1), component_names=tuple(message.component_names),
            success=message.success, valid=message.valid.astype(bool), reward_name=message.reward_name,
            reward_version=int(message.reward_version),
        )
        self._rewards.setdefault(key, reward)

    def _keep_goals(self, message: Any) -> None:
        if not len(message.goal_image.data):
            return
        for goal, is_found, episode in zip(
            self._untile(message.goal_image), message.goal_found, message.episode_id, strict=False
        ):
            self._goals[int(episode)] = goal, bool(is_found)

    def _keep_event(self, message: Any) -> None:
        key = int(message.session), int(message.env_index), int(message.episode_id)
        known = self.events.get(key)
        if known is None or known.kind != KIND_END:
            self.events[key] = message

    def _is_complete(self, message: Any) -> bool:
        if stamp_ns(message.header.stamp) not in self._images or stamp_ns(message.next_stamp) not in self._images:
            return False
        expects_reward = self._counts[topics.REWARD] > 0 and message.valid.any()
        return not expects_reward or _reward_key(message) in self._rewards

    def _join_step(self, message: Any) -> RecordedStep:
        spec = self.spec
        num_envs = spec.num_envs
        now_ns, next_ns = stamp_ns(message.header.stamp), stamp_ns(message.next_stamp)
        truth = message.ground_truth
        if not len(truth):
            truth = np.full(num_envs * spec.ground_truth_dim, np.nan, np.float32)
        goals = [self._goals.get(int(episode)) for episode in message.episode_id]
        step = RecordedStep(
            session=int(message.session), seq=int(message.seq), step_id=int(message.step_id), stamp_ns=now_ns,
            next_stamp_ns=next_ns, images=self._images.get(now_ns), next_images=self._images.get(next_ns),
            goals=self._stack_goals(goals) if any(goal is not None for goal in goals) else None,
            actions=_per_env(message.action, num_envs), states=_per_env(message.state, num_envs),
            next_states=_per_env(message.next_state, num_envs), logprobs=message.log_prob, values=message.value,
            terminated=message.terminated.astype(bool), truncated=message.truncated.astype(bool),
            valid=message.valid.astype(bool), episode_id=message.episode_id, episode_step=message.episode_step,
            policy_version=message.policy_version, success_probability=message.success_probability,
            uncertainty=message.model_uncertainty, ground_truth=truth.reshape(num_envs, spec.ground_truth_dim),
            source=int(message.source), reward=self._rewards.pop(_reward_key(message), None),
        )
        self._drop_images([stamp for stamp in self._images if stamp < now_ns])
        return step

    def _drop_images(self, stamps: list[int]) -> None:
        for stamp in stamps:
            del self._images[stamp], self._received[stamp]

    def _forget_images(self, restart_ns: int) -> None:
        """Drop what the environment before a restart showed, going by when it came: in older recordings stamps count
        observations, anew after every restart."""
        before = self._last_transition_ns
        self._drop_images([stamp for stamp, came in self._received.items() if came - before < restart_ns - came])

    def _stack_goals(self, goals: list[tuple[UInt8Array, bool] | None]) -> tuple[UInt8Array, BoolArray]:
        blank = np.zeros((self.spec.height, self.spec.width, self.spec.channels), np.uint8), False
        pairs = [goal if goal is not None else blank for goal in goals]
        return np.stack([image for image, _ in pairs]), np.array([is_found for _, is_found in pairs])


def _per_env(values: FloatArray, num_envs: int) -> FloatArray:
    """A message's values as (N, values of each), which may be none."""
    return values.reshape(num_envs, len(values) // num_envs)


def _reward_key(message: Any) -> tuple[int, int, int]:
    return int(message.session), int(message.step_id), stamp_ns(message.header.stamp)
