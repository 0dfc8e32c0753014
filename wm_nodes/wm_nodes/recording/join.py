"""Join what is published about each lock-step, live, replayed or recorded: the transition, both images by exact stamp,
the rewards by session, step id and stamp, the goals by episode; and cut lock-steps into rollouts.

Streaming: what waits is in memory, never a bag. Shapes: N environments, T lock-steps, H W 3 image.
"""

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import DroppedTransitions, Goals, LockStep, Rewards, StepKey
from wm_nodes.core.types import BoolArray, Rollout, UInt8Array
from wm_nodes.recording import topics
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.messages import KIND_END, goals_of, images_of, lockstep_of, rewards_of, stamp_ns

MAX_LAG = 64
"""Recorded lock-steps that may pass before an image counts as missing, or the rewards from before a reset, or rewards
of which later ones have come."""

KEPT = 64
"""Images and rewards, and goals of each environment, that are kept for a lock-step that comes after them: topics are
not ordered among each other."""


class Joiner:
    """Keeps images, rewards and goals until the lock-steps that they belong to have them. The first rewards of a
    lock-step count. Either put lock-steps in and take them out in their order, or hold them, ask for them by
    is_complete and joined, and release them.

    holding: whether lock-steps are held outside; all images and rewards that come are then kept.

    Args:
        with_rewards: a lock-step in which anybody stepped is complete only with its rewards.
        with_goals: it is complete only with the goals of the episodes that stepped.
    """

    def __init__(self, *, with_rewards: bool = False, with_goals: bool = False) -> None:
        self._with_rewards, self._with_goals = with_rewards, with_goals
        self._goals_come = with_goals
        self.holding = False
        self._images: dict[int, UInt8Array] = {}
        self._rewards: dict[StepKey, Rewards] = {}
        self._goals: dict[tuple[int, int], tuple[UInt8Array | None, bool]] = {}
        self._waiting: deque[tuple[float, LockStep]] = deque()
        self._num_put = 0
        self._resets: deque[int] = deque()
        """How many lock-steps had been put before each reset, or restart, that comes after the oldest that waits."""
        self._newest_rewards: tuple[int, int] | None = None
        """Session and step id."""

    def clear(self) -> None:
        """Forget everything."""
        self._images.clear()
        self._rewards.clear()
        self._goals.clear()
        self._waiting.clear()
        self._resets.clear()
        self._newest_rewards = None
        self._goals_come = self._with_goals

    def put_image(self, stamp_ns: int, images: UInt8Array) -> None:
        self._images[stamp_ns] = images
        self._bound(self._images)

    def put_rewards(self, rewards: Rewards) -> None:
        self._rewards.setdefault(rewards.key, rewards)
        self._newest_rewards = rewards.session, rewards.step_id
        self._bound(self._rewards)

    def end_rewards(self) -> None:
        """No more will come: nothing waits for them any longer."""
        self._with_rewards = False

    def put_goals(self, goals: Goals) -> None:
        for n, episode_id in enumerate(goals.episode_ids):
            key = goals.session, int(episode_id)
            self._goals.pop(key, None)  # the newest last
            self._goals[key] = None if goals.images is None else goals.images[n], bool(goals.found[n])
        while len(self._goals) > (KEPT + len(self._waiting)) * len(goals.episode_ids):
            del self._goals[next(iter(self._goals))]

    def put_step(self, step: LockStep) -> None:
        """The next lock-step to be taken."""
        if self._waiting and (step.is_reset or step.session != self._waiting[-1][1].session):
            self._resets.append(self._num_put)
        self._waiting.append((time.monotonic(), step))
        self._num_put += 1

    def take(self, *, patience_s: float = math.inf, max_behind: int = sys.maxsize) -> Iterator[LockStep]:
        """Take out, in order, the lock-steps that are complete, and those that are too late, with what they have: they
        waited for patience_s, or max_behind is exceeded. Goals that nobody publishes are waited for once.

        A reward agent judges episodes, while whole rollouts come before its first verdict. Rewards, which are published
        in the order of the lock-steps, are therefore waited for until later ones have come, or until the next reset:
        what waits is no more than a rollout and max_behind, or what comes before the next or the last rewards.

        Args:
            max_behind: lock-steps that may wait behind one that lacks an image or a goal, or rewards of which later
                ones have come; and from the next reset on, behind one that lacks rewards.
        """
        while self._waiting:
            since, step = self._waiting[0]
            if not self.is_complete(step):
                if not self._is_late(step, max_behind) and time.monotonic() - since < patience_s:
                    return
                if not self._goals and self._has_images(step):
                    self._goals_come = False
            self._waiting.popleft()
            joined = self.joined(step)
            self.release([step])
            yield joined

    def is_complete(self, step: LockStep) -> bool:
        return self._has_images(step) and self._has_rewards(step) and self._has_goals(step)

    def joined(self, step: LockStep) -> LockStep:
        """The lock-step with what has come for it."""
        return replace(
            step, images=self._images.get(step.stamp_ns), next_images=self._images.get(step.next_stamp_ns),
            goals=self._goals_of(step), rewards=self._rewards.get(step.key),
        )

    def release(self, steps: Sequence[LockStep]) -> None:
        """Forget the rewards of lock-steps, and the images that came before the last one's."""
        for step in steps:
            self._rewards.pop(step.key, None)
        if (last := steps[-1].stamp_ns) in self._images:
            while next(iter(self._images)) != last:
                del self._images[next(iter(self._images))]

    def _bound(self, kept: dict[Any, Any]) -> None:
        while len(kept) > KEPT and not self.holding and not self._waiting:
            del kept[next(iter(kept))]

    def _has_images(self, step: LockStep) -> bool:
        return step.stamp_ns in self._images and step.next_stamp_ns in self._images

    def _has_rewards(self, step: LockStep) -> bool:
        """Or needs none."""
        return not self._with_rewards or not step.valid.any() or step.key in self._rewards

    def _has_goals(self, step: LockStep) -> bool:
        """Or needs none."""
        episodes = step.episode_ids[step.valid] if self._goals_come else ()
        return all((step.session, int(episode_id)) in self._goals for episode_id in episodes)

    def _is_late(self, step: LockStep, max_behind: int) -> bool:
        """Whether nothing that the oldest lock-step lacks is waited for any longer."""
        is_long = len(self._waiting) > max_behind
        if not is_long and not (self._has_images(step) and self._has_goals(step)):
            return False
        return self._has_rewards(step) or self._since_reset() > max_behind or (is_long and self._is_passed_over(step))

    def _since_reset(self) -> int:
        """Lock-steps from the first reset after the oldest one on; 0 while none has come."""
        oldest = self._num_put - len(self._waiting)
        while self._resets and self._resets[0] <= oldest:
            self._resets.popleft()
        return self._num_put - self._resets[0] if self._resets else 0

    def _is_passed_over(self, step: LockStep) -> bool:
        """Whether rewards of a later lock-step of its session have come."""
        newest = self._newest_rewards
        return newest is not None and newest[0] == step.session and newest[1] > step.step_id

    def _goals_of(self, step: LockStep) -> tuple[UInt8Array, BoolArray] | None:
        goals = [self._goals.get((step.session, int(episode_id)), (None, False)) for episode_id in step.episode_ids]
        blank = next((np.zeros_like(image) for image, _ in goals if image is not None), None)
        if blank is None:
            return None
        images = np.stack([blank if image is None else image for image, _ in goals])
        return images, np.array([image is not None and known for image, known in goals])


class LockSteps:
    """Iterate over the joined lock-steps of one environment in a bag.

    events: (session, env_index, episode_id) to the newest EpisodeEvent read so far; the reader removes what it used.
    lost: sequence numbers missing on env/transition so far.

    Args:
        namespace: of the environment; None takes the only one.
        reward_name: which evaluator's rewards to join; None takes the first that answered.
    """

    def __init__(self, bag: Bag, *, namespace: str | None = None, reward_name: str | None = None) -> None:
        self.bag = bag
        self.namespace = bag.namespace(namespace)
        self.spec, self._tiles = bag.spec(self.namespace)
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
        self._joiner = Joiner(with_rewards=self._counts[topics.REWARD] > 0)
        self._rewards_to_come = self._counts[topics.REWARD]
        self._last_seq: tuple[int, int] | None = None

    @property
    def has_events(self) -> bool:
        return self._counts[topics.EPISODE] > 0

    def __iter__(self) -> Iterator[LockStep]:
        put: dict[topics.RecordedTopic, Callable[[Any], None]] = {
            topics.IMAGES: self._put_image, topics.TRANSITION: self._put_transition, topics.REWARD: self._put_reward,
            topics.EPISODE: self._put_event, topics.GOAL: self._put_goals,
        }
        names = [name for name, topic in self._names.items() if topic in put]
        for name, _, data in self.bag.messages(names):
            topic = self._names[name]
            message = self.bag.decode(data, topic.msgtype)
            try:
                put[topic](message)
            except WireError as error:
                raise BagError(
                    f"{topic.name} with stamp {stamp_ns(message.header.stamp)} in {self.bag.path}: {error}; the bag's "
                    "env/spec describes another robot, camera or layout, so record spec and data of one environment"
                ) from None
            yield from self._joiner.take(max_behind=MAX_LAG)
        yield from self._joiner.take(patience_s=0.0)

    def _put_image(self, message: Any) -> None:
        self._joiner.put_image(stamp_ns(message.header.stamp), images_of(message, self.spec, self._tiles))

    def _put_transition(self, message: Any) -> None:
        self._joiner.put_step(lockstep_of(message, self.spec))
        if self._last_seq is not None and self._last_seq[0] == message.session:
            self.lost += max(0, int(message.seq) - self._last_seq[1] - 1)
        self._last_seq = int(message.session), int(message.seq)

    def _put_reward(self, message: Any) -> None:
        if self._reward_name in (None, message.reward_name):
            self._joiner.put_rewards(rewards_of(message))
        self._rewards_to_come -= 1
        if not self._rewards_to_come:
            self._joiner.end_rewards()

    def _put_goals(self, message: Any) -> None:
        if len(message.goal_image.data):
            self._joiner.put_goals(goals_of(message, self.spec, self._tiles))

    def _put_event(self, message: Any) -> None:
        key = int(message.session), int(message.env_index), int(message.episode_id)
        known = self.events.get(key)
        if known is None or known.kind != KIND_END:
            self.events[key] = message


def version_of(step: LockStep) -> int:
    """The policy version that acted."""
    return int(step.policy_versions.max())


def begins_rollout(step: LockStep, first: LockStep | None) -> bool:
    """Whether a lock-step is no more of the rollout that began with `first`: after env/reset, by another version, or of
    a restarted environment."""
    return step.is_reset or (
        first is not None and (step.session, version_of(step)) != (first.session, version_of(first))
    )


def rollout_problem(steps: Sequence[LockStep], num_steps: int | None) -> str:
    """Why joined lock-steps are no whole rollout; "" where they are. num_steps: None takes any length."""
    if num_steps is not None and len(steps) != num_steps:
        return f"{len(steps)} lock-steps instead of {num_steps}"
    for previous, step in pairwise(steps):
        if step.step_id != previous.step_id + 1:
            return f"step_id {previous.step_id + 1} is missing"
    for step in steps:
        if step.images is None or step.next_images is None:
            return f"an image of step_id {step.step_id} is missing"
        if step.rewards is None and step.valid.any():
            return f"the reward of step_id {step.step_id} is missing"
    return ""


def rollout_of(steps: Sequence[LockStep | None], policy_version: int) -> tuple[Rollout, DroppedTransitions]:
    """The rollout of joined lock-steps, and what was left out of it.

    valid is the lock-step's and the reward's, where policy_version acted; the reward of an invalid entry is what the
    evaluator published, NaN where it published none.

    Args:
        steps: None: it did not arrive completely; its row is zeros, invalid and a gap.

    Raises:
        ValueError: not a single lock-step is there.
    """
    known = [step for step in steps if step is not None]
    if not known:
        raise ValueError(f"none of {len(steps)} lock-steps arrived completely")
    num_envs = len(known[0].valid)

    def stack(name: str) -> Any:
        blank = np.zeros_like(getattr(known[0], name))
        return np.stack([blank if step is None else getattr(step, name) for step in steps])

    def rewards(name: str, without: Any) -> Any:
        none = np.full(num_envs, without)
        given = [step.rewards if step is not None else None for step in steps]
        return np.stack([none if each is None else getattr(each, name) for each in given])

    made_TN = stack("valid")
    fresh_TN, judged_TN = stack("policy_versions") == policy_version, rewards("valid", False)
    rollout = Rollout(
        images_TN=stack("images"), states_TN=stack("states"), next_images_TN=stack("next_images"),
        next_states_TN=stack("next_states"), actions_TN=stack("actions"), logprobs_TN=stack("logprobs"),
        values_TN=stack("values"), rewards_TN=rewards("total", np.float32(np.nan)), terminated_TN=stack("terminated"),
        truncated_TN=stack("truncated"), valid_TN=made_TN & judged_TN & fresh_TN, policy_version=policy_version,
    )
    return rollout, DroppedTransitions(
        invalid=int((made_TN & fresh_TN & ~judged_TN).sum()), gap=(len(steps) - len(known)) * num_envs,
        stale=int((made_TN & ~fresh_TN).sum()),
    )
