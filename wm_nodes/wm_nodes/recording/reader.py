"""Episodes back out of a bag: written by EpisodeBagWriter, or recorded live. They stream; only the episodes in progress
are in memory."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.specs import POLICY_FIELDS, EnvironmentSpec, SpecMismatch, agree
from wm_nodes.core.types import Episode, FloatArray, UInt8Array
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.join import MAX_LAG, LockSteps
from wm_nodes.recording.messages import KIND_END

EPISODE_FIELDS = (*POLICY_FIELDS, "ground_truth_names")
"""What training a world model depends on."""


@dataclass
class BagReport:
    """What a reader left out, and why. Filled while reading.

    unfinished: episodes the recording cut off at its start or end. incomplete: one line per episode or rollout that
    lost an image, a step or (rollouts) a reward. lost_steps: sequence numbers missing on env/transition.
    """

    yielded: int = 0
    unfinished: int = 0
    incomplete: list[str] = field(default_factory=list)
    lost_steps: int = 0
    missing_rewards: int = 0


@dataclass
class _Builder:
    """An episode in progress in one environment slot."""

    session: int
    episode_id: int
    images: list[UInt8Array]
    states: list[FloatArray]
    truth: list[FloatArray]
    success: list[bool]
    actions: list[FloatArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    last: LockStep | None = None
    problem: str = ""
    finished_at: int = 0


def read_spec(path: Path, *, namespace: str | None = None) -> EnvironmentSpec:
    """Return the spec of the recorded environment. num_envs is 1 in bags of EpisodeBagWriter."""
    with Bag(path) as bag:
        return bag.spec(bag.namespace(namespace))[0]


def read_episodes(
    path: Path, *, behaviours: Collection[str] | None = None, expected: EnvironmentSpec | None = None,
    namespace: str | None = None, report: BagReport | None = None,
) -> Iterator[Episode]:
    """Yield the complete episodes of a bag in the order in which they ended.

    An episode that a reset cut short has neither terminated nor truncated set. Rewards that were never published, or
    were published as invalid, are NaN. success is success_probability >= 0.5 (exact in a simulator).

    Args:
        behaviours: keep only these; None keeps all.
        expected: refuse a bag of another camera, size, action or state than this spec.
        namespace: of the environment, where the bag holds several.
        report: given, episodes that lost an image or a step are counted there; else they raise.

    Raises:
        BagError: names the value and the remedy.
    """
    notes = report if report is not None else BagReport()
    with Bag(path) as bag:
        steps = LockSteps(bag, namespace=namespace)
        if expected is not None:
            check_spec(steps.spec, expected, where=str(path))
        extras = {row["episode_id"]: row["extra"] for row in bag.episode_table()}
        joiner = _EpisodeJoiner(steps, extras, strict=report is None, notes=notes)
        for episode in joiner:
            if behaviours is None or episode.behaviour in behaviours:
                notes.yielded += 1
                yield episode


def check_spec(
    recorded: EnvironmentSpec, expected: EnvironmentSpec, *, where: str, names: Sequence[str] = EPISODE_FIELDS
) -> None:
    """Raise BagError unless both agree on the named fields, see core.specs.agree."""
    try:
        agree(recorded, expected, "expected here is", names)
    except SpecMismatch as error:
        raise BagError(f"{where} was recorded with another set-up: {error}") from None


class _EpisodeJoiner:
    """Cuts lock-steps into the episodes of each environment slot."""

    def __init__(self, steps: LockSteps, extras: dict[int, Any], *, strict: bool, notes: BagReport) -> None:
        self._steps, self._extras, self._strict, self._notes = steps, extras, strict, notes
        self._is_live = "wm.writer" not in steps.bag.custom
        num_envs = steps.spec.num_envs
        self._open: list[_Builder | None] = [None] * num_envs
        self._skipped: list[tuple[int, int] | None] = [None] * num_envs
        self._first: list[tuple[int, FloatArray, bool] | None] = [None] * num_envs
        self._waiting: list[tuple[int, _Builder]] = []
        self._clock = 0

    def __iter__(self) -> Iterator[Episode]:
        for step in self._steps:
            self._clock += 1
            for index in range(self._steps.spec.num_envs):
                self._add_step(step, index)
            yield from self._finished_episodes(final=False)
        yield from self._finished_episodes(final=True)
        self._notes.unfinished += sum(builder is not None for builder in self._open)
        self._notes.lost_steps += self._steps.lost

    def _add_step(self, step: LockStep, index: int) -> None:
        builder = self._open[index]
        key = step.session, int(step.episode_ids[index])
        if builder is not None and key != (builder.session, builder.episode_id):
            self._finish(index)
            builder = None
        success = bool(step.success_probability[index] >= 0.5)
        if not step.valid[index]:
            self._first[index] = step.next_stamp_ns, step.ground_truth[index], success
            return
        if builder is None:
            builder = self._start(step, index, key)
            if builder is None:
                return
        if step.episode_steps[index] != len(builder.actions):
            builder.problem = builder.problem or f"step {len(builder.actions)} is missing"
        if step.next_images is None:
            builder.problem = builder.problem or f"the image at stamp {step.next_stamp_ns} is missing"
        else:
            builder.images.append(step.next_images[index])
        builder.actions.append(step.actions[index])
        builder.states.append(step.next_states[index])
        builder.truth.append(step.ground_truth[index])
        builder.success.append(success)
        has_reward = step.rewards is not None and bool(step.rewards.valid[index])
        builder.rewards.append(float(step.rewards.total[index]) if step.rewards is not None and has_reward else np.nan)
        builder.last = step
        if step.terminated[index] or step.truncated[index]:
            self._finish(index)

    def _start(self, step: LockStep, index: int, key: tuple[int, int]) -> _Builder | None:
        """Open an episode at its first step; None inside an episode whose beginning was not recorded."""
        if step.episode_steps[index] != 0:
            if self._skipped[index] != key:
                self._skipped[index] = key
                self._notes.unfinished += 1
            return None
        stamp_ns, truth, success = self._first[index] or (-1, step.ground_truth[index], False)
        if stamp_ns != step.stamp_ns:
            truth, success = np.full_like(step.ground_truth[index], np.nan), False
        builder = _Builder(*key, [], [step.states[index]], [truth], [success])
        if step.images is None:
            builder.problem = f"the image at stamp {step.stamp_ns} is missing"
        else:
            builder.images.append(step.images[index])
        self._open[index] = builder
        return builder

    def _finish(self, index: int) -> None:
        builder, self._open[index] = self._open[index], None
        if builder is not None:
            builder.finished_at = self._clock
            self._waiting.append((index, builder))

    def _finished_episodes(self, *, final: bool) -> Iterator[Episode]:
        """Episodes whose end event has come too, in order; without one after MAX_LAG lock-steps."""
        while self._waiting:
            index, builder = self._waiting[0]
            key = builder.session, index, builder.episode_id
            event = self._steps.events.get(key)
            is_late = final or not self._steps.has_events or self._clock - builder.finished_at > MAX_LAG
            if not is_late and (event is None or event.kind != KIND_END):
                return
            self._waiting.pop(0)
            self._steps.events.pop(key, None)
            if builder.problem:
                self._report_problem(index, builder)
            else:
                yield self._make_episode(index, builder, event)

    def _report_problem(self, index: int, builder: _Builder) -> None:
        text = f"episode {builder.episode_id} of environment {index}: {builder.problem}"
        if self._strict:
            raise BagError(
                f"{text} in {self._steps.bag.path} (the recorder's losses are in custom_data wm.recorder_drops); pass "
                "report=BagReport() to leave such episodes out and count them"
            )
        self._notes.incomplete.append(text)

    def _make_episode(self, index: int, builder: _Builder, event: Any) -> Episode:
        spec, last = self._steps.spec, builder.last
        assert last is not None
        rewards = np.array(builder.rewards, np.float32)
        self._notes.missing_rewards += int(np.isnan(rewards).sum())
        extra: dict[str, Any] = self._extras.get(builder.episode_id, {})
        if self._is_live:
            reason = int(event.termination_reason) if event is not None else 0
            extra = {"env_index": index, "session": builder.session, "termination_reason": reason}
        return Episode(
            images=np.stack(builder.images), states=np.stack(builder.states), actions=np.stack(builder.actions),
            ground_truth=np.stack(builder.truth), success=np.array(builder.success), rewards=rewards,
            terminated=bool(last.terminated[index]), truncated=bool(last.truncated[index]),
            task=event.task if event is not None else spec.task,
            instruction=event.instruction if event is not None else spec.instruction,
            behaviour=event.behaviour if event is not None else "", seed=int(event.seed) if event is not None else 0,
            episode_id=builder.episode_id, source=last.source, policy_version=int(last.policy_versions[index]),
            extra=extra,
        )
