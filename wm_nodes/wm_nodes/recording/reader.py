"""Episodes back out of a bag: written by EpisodeBagWriter, or recorded live. They stream; only the episodes in progress
are in memory."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.specs import POLICY_FIELDS, EnvironmentSpec, SpecMismatch, agree
from wm_nodes.core.types import Episode, FloatArray
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.join import MAX_LAG, LockSteps
from wm_nodes.recording.messages import KIND_END


@dataclass
class BagReport:
    """What a reader left out, and why. Filled while reading."""

    yielded: int = 0
    """Episodes or rollouts that were given."""
    unfinished: int = 0
    """Episodes that the recording cut off at its start or end."""
    incomplete: list[str] = field(default_factory=list)
    """A line per episode or rollout that lost an image, a step or (rollouts) a reward."""
    lost_steps: int = 0
    """Sequence numbers missing on env/transition."""
    missing_rewards: int = 0
    """Steps without a valid reward in the episodes that were given."""


@dataclass
class _Running:
    """An episode in progress in one environment slot."""

    session: int
    """Of the environment."""
    episode_id: int
    """Of the episode."""
    truth: FloatArray
    """(P,) of the first frame."""
    success: bool
    """At the first frame."""
    steps: list[LockStep] = field(default_factory=list)
    """What was recorded of it, in order."""
    problem: str = ""
    """Why it is incomplete; empty: it is not."""
    finished_at: int = 0
    """Lock-steps of the bag before its end."""


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
    recorded: EnvironmentSpec, expected: EnvironmentSpec, *, where: str, names: Sequence[str] = POLICY_FIELDS
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
        self._open: list[_Running | None] = [None] * num_envs
        self._skipped: list[tuple[int, int] | None] = [None] * num_envs
        self._first: list[LockStep | None] = [None] * num_envs
        self._waiting: list[tuple[int, _Running]] = []
        self._clock = 0

    def __iter__(self) -> Iterator[Episode]:
        for step in self._steps:
            self._clock += 1
            for index in range(self._steps.spec.num_envs):
                self._add_step(step, index)
            yield from self._finished_episodes(final=False)
        yield from self._finished_episodes(final=True)
        self._notes.unfinished += sum(episode is not None for episode in self._open)
        self._notes.lost_steps += self._steps.lost

    def _add_step(self, step: LockStep, index: int) -> None:
        episode = self._open[index]
        key = step.session, int(step.episode_ids[index])
        if episode is not None and key != (episode.session, episode.episode_id):
            self._finish(index)
            episode = None
        if not step.valid[index]:
            self._first[index] = step
            return
        if episode is None:
            episode = self._start(step, index, key)
            if episode is None:
                return
        if step.episode_steps[index] != len(episode.steps):
            episode.problem = episode.problem or f"step {len(episode.steps)} is missing"
        if step.next_images is None:
            episode.problem = episode.problem or f"the image at stamp {step.next_stamp_ns} is missing"
        episode.steps.append(step)
        if step.ended[index]:
            self._finish(index)

    def _start(self, step: LockStep, index: int, key: tuple[int, int]) -> _Running | None:
        """Open an episode at its first step; None inside an episode whose beginning was not recorded."""
        if step.episode_steps[index] != 0:
            if self._skipped[index] != key:
                self._skipped[index] = key
                self._notes.unfinished += 1
            return None
        shown = self._first[index]
        if shown is not None and shown.next_stamp_ns == step.stamp_ns:
            episode = _Running(*key, shown.ground_truth[index], _succeeded(shown, index))
        else:
            episode = _Running(*key, np.full_like(step.ground_truth[index], np.nan), False)
        if step.images is None:
            episode.problem = f"the image at stamp {step.stamp_ns} is missing"
        self._open[index] = episode
        return episode

    def _finish(self, index: int) -> None:
        episode, self._open[index] = self._open[index], None
        if episode is not None:
            episode.finished_at = self._clock
            self._waiting.append((index, episode))

    def _finished_episodes(self, *, final: bool) -> Iterator[Episode]:
        """Episodes whose end event has come too, in order; without one after MAX_LAG lock-steps."""
        while self._waiting:
            index, episode = self._waiting[0]
            key = episode.session, index, episode.episode_id
            event = self._steps.events.get(key)
            is_late = final or not self._steps.has_events or self._clock - episode.finished_at > MAX_LAG
            if not is_late and (event is None or event.kind != KIND_END):
                return
            self._waiting.pop(0)
            self._steps.events.pop(key, None)
            if episode.problem:
                self._report_problem(index, episode)
            else:
                yield self._make_episode(index, episode, event)

    def _report_problem(self, index: int, episode: _Running) -> None:
        text = f"episode {episode.episode_id} of environment {index}: {episode.problem}"
        if self._strict:
            raise BagError(
                f"{text} in {self._steps.bag.path} (the recorder's losses are in custom_data wm.recorder_drops); pass "
                "report=BagReport() to leave such episodes out and count them"
            )
        self._notes.incomplete.append(text)

    def _make_episode(self, index: int, running: _Running, event: Any) -> Episode:
        spec, steps, last = self._steps.spec, running.steps, running.steps[-1]
        rewards = np.array([_reward(step, index) for step in steps], np.float32)
        self._notes.missing_rewards += int(np.isnan(rewards).sum())
        extra: dict[str, Any] = self._extras.get(running.episode_id, {})
        if self._is_live:
            reason = int(event.termination_reason) if event is not None else 0
            extra = {"env_index": index, "session": running.session, "termination_reason": reason}
        images = [step.next_images[index] for step in steps if step.next_images is not None]
        assert steps[0].images is not None  # else it has a problem
        return Episode(
            images=np.stack([steps[0].images[index], *images]),
            states=np.stack([steps[0].states[index], *(step.next_states[index] for step in steps)]),
            actions=np.stack([step.actions[index] for step in steps]),
            ground_truth=np.stack([running.truth, *(step.ground_truth[index] for step in steps)]),
            success=np.array([running.success, *(_succeeded(step, index) for step in steps)]), rewards=rewards,
            terminated=bool(last.terminated[index]), truncated=bool(last.truncated[index]),
            task=event.task if event is not None else spec.task,
            instruction=event.instruction if event is not None else spec.instruction,
            behaviour=event.behaviour if event is not None else "", seed=int(event.seed) if event is not None else 0,
            episode_id=running.episode_id, source=last.source, policy_version=int(last.policy_versions[index]),
            extra=extra,
        )


def _succeeded(step: LockStep, index: int) -> bool:
    return bool(step.success_probability[index] >= 0.5)


def _reward(step: LockStep, index: int) -> float:
    """NaN where it is missing or invalid."""
    rewards = step.rewards
    return float(rewards.total[index]) if rewards is not None and rewards.valid[index] else np.nan
