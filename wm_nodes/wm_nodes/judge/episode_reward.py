"""The reward agent as reward of a policy: an episode is judged as a clip at its end and rewarded at its last step
(RA-15).

Every rollout begins with a reset, so an episode that is unfinished at the rollout's end is never continued and never
judged. Its rewards are exactly 0, because the reward comes with the last step only, and PPO bootstraps from the value
of its last state. An episode that ended has the verdict's reward and no bootstrap.

Shapes: N environments, T steps of an episode, H W 3 image, A action.
"""

from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import judge_or_embedded
from wm_nodes.config.schema import AGENT, RunConfig
from wm_nodes.config.tasks import parts_of
from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, FloatArray, Rollout, UInt8Array
from wm_nodes.environments.registry import configured_spec
from wm_nodes.judge.agent.contract import MAX_INVALID_SHARE
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.factory import check_clips, check_judge, for_task
from wm_nodes.judge.service import ClipJob, JudgeService
from wm_nodes.reward import SUCCESS_UNKNOWN, RewardResult
from wm_nodes.reward.base import version_of


@dataclass
class _Episode:
    """The collected part of an episode."""

    episode_id: int
    """As in the messages."""
    frames: list[UInt8Array] = field(default_factory=list)
    """uint8 (H, W, 3) each."""
    actions: list[FloatArray] = field(default_factory=list)
    """(A,) each."""
    goal: UInt8Array | None = None
    """The newest goal image."""
    fault: str = ""
    """Why it cannot be judged."""


@dataclass(frozen=True)
class PendingReward:
    """The rewards of a lock-step, available once the episodes that end with it are judged.

    waited: by environment, the future verdict, or why there will be none.
    """

    valid: BoolArray
    waited: Mapping[int, "Future[Verdict] | str"]

    @property
    def done(self) -> bool:
        return all(isinstance(outcome, str) or outcome.done() for outcome in self.waited.values())

    def cancel(self) -> None:
        for outcome in self.waited.values():
            if not isinstance(outcome, str):
                outcome.cancel()

    def verdicts(self) -> dict[int, Verdict]:
        """The verdicts by environment; call it only when done."""
        return {n: verdict for n, verdict in self._outcomes() if not isinstance(verdict, str)}

    def problems(self) -> dict[int, str]:
        """Why the other environments whose episode ended have none; call it only when done."""
        return {n: reason for n, reason in self._outcomes() if isinstance(reason, str)}

    def result(self) -> RewardResult:
        """The rewards: 0 within an episode, the verdict's at its last step, invalid without one; call it when done."""
        total, valid, reasons = np.zeros(len(self.valid), np.float32), self.valid.copy(), list[str]()
        for n, outcome in self._outcomes():
            if isinstance(outcome, str) or not outcome.valid:
                valid[n] = False
                reason = outcome if isinstance(outcome, str) else f"{outcome.status} {outcome.reason}"
                reasons.append(f"environment {n}: {reason}")
            else:
                total[n] = outcome.reward
        total = np.where(valid, total, np.float32(np.nan)).astype(np.float32)
        none = np.where(valid, np.float32(0), np.float32(np.nan)).astype(np.float32)
        return RewardResult(
            total=total, dense=none, sparse=total, valid=valid,
            success=np.full(len(valid), SUCCESS_UNKNOWN, np.uint8), invalid_reason="; ".join(reasons),
            components={"dense": none, "sparse": total}, weights={"dense": 0.0, "sparse": 1.0},
        )

    def _outcomes(self) -> Iterator[tuple[int, Verdict | str]]:
        """The verdict of each environment, or why there is none: what went wrong in the judging is a reason, too."""
        for n, outcome in self.waited.items():
            try:
                yield n, outcome if isinstance(outcome, str) else outcome.result()
            except Exception as error:
                yield n, f"{type(error).__name__}: {error}"


def check_agent(config: RunConfig, *, trains: bool = True) -> None:
    """Refuse settings by which episodes of the configured scene could not be judged, before anything is made.

    trains: rollouts of ppo.num_steps are trained on.

    Raises:
        ValueError, ConfigError: as check_judge, load_rubric, check_horizon and check_clips; or the task is one of
            several, and nobody tells the judge which.
    """
    check_judge(config.judge)
    if len(parts := parts_of(config.task)) > 1:
        raise ValueError(
            f"an episode of task {config.task!r} is of one of {', '.join(parts)}, and the reward agent is not told of "
            "which, so that it could judge none; name one of them, or another reward"
        )
    load_rubric(config.judge.rubric)
    spec = configured_spec(config)
    if trains:
        check_horizon(config.ppo.num_steps, spec.max_episode_steps)
    check_clips(for_task(config.judge, config.task), _longest_clip(spec), 1 / spec.control_period_s)


def episode_judge(config: RunConfig) -> JudgeConfig:
    """The judge's settings for episodes of the configured scene, see judge_or_embedded and for_task."""
    return for_task(judge_or_embedded(config.judge), config.task)


def _longest_clip(spec: EnvironmentSpec) -> tuple[int, ...]:
    """Shape of the longest episode as a clip."""
    return (spec.max_episode_steps + 1, spec.height, spec.width, spec.channels)


def check_horizon(num_steps: int, max_episode_steps: int) -> None:
    """Refuse rollouts shorter than an episode, of which only those that end early are judged. Raises ValueError."""
    if num_steps < max_episode_steps:
        raise ValueError(
            f"ppo.num_steps is {num_steps}, but an episode may take {max_episode_steps} steps: the reward agent judges "
            "it at its end, which such a rollout would cut off; set ppo.num_steps to at least that many"
        )


def unjudged_reason(rollout: Rollout) -> str:
    """Why training must pause before it uses a rollout that the agent judged; "" where it may go on.

    It pauses if no episode of the rollout ended, or if more than MAX_INVALID_SHARE of the ended ones have no reward.
    """
    ended = rollout.terminated_TN | rollout.truncated_TN
    without, count = int((ended & ~rollout.valid_TN).sum()), int(ended.sum())
    if count == 0:
        return (
            f"training pauses: none of the episodes in a rollout of {len(ended)} lock-steps (ppo.num_steps) was seen "
            "to end, so none was judged; nothing was trained on it. Raise ppo.num_steps, or mend what loses messages"
        )
    if without <= MAX_INVALID_SHARE * count:
        return ""
    return (
        f"training pauses: {without} of {count} episodes of a rollout ended without a verdict, more than "
        f"{MAX_INVALID_SHARE:.0%}; nothing was trained on it. See reward/verdict for the reasons, mend the judge, and "
        "train again: the same rollout is then made"
    )


class EpisodeReward:
    """Collects the lock-steps of one environment node into episodes and has each judged at its end.

    cut: episodes that a reset ended before their last step, unjudged.
    """

    name = AGENT

    def __init__(self, judge: JudgeService) -> None:
        self._judge = judge
        self.cut = 0
        self._open: dict[int, _Episode] = {}

    @property
    def version(self) -> int:
        """Differs with judge, rubric and mode; fits uint64."""
        return version_of(self.name, self._judge.judge_id, self._judge.version, self._judge.settings.mode)

    def forget(self) -> None:
        """Drop the unfinished episodes, because the environment was (re)started."""
        self.cut += len(self._open)
        self._open.clear()

    def add(self, step: LockStep, spec: EnvironmentSpec) -> PendingReward:
        """Add the next lock-step of the environment, joined, and judge the episodes that end with it."""
        waited: dict[int, Future[Verdict] | str] = {}
        for n in map(int, np.flatnonzero(step.valid)):
            episode = self._extend(n, step)
            if step.ended[n]:
                del self._open[n]
                waited[n] = episode.fault or self._judge.submit(self._job(episode, spec, step.session))
        return PendingReward(step.valid, waited)

    def _extend(self, n: int, step: LockStep) -> _Episode:
        """Add the step to the episode of environment n and return the episode."""
        episode, episode_id = self._open.get(n), int(step.episode_ids[n])
        if episode is None or episode.episode_id != episode_id:
            self.cut += episode is not None
            episode = self._open[n] = _Episode(episode_id)
        num_steps = len(episode.actions)
        if num_steps != step.episode_steps[n]:
            episode.fault = episode.fault or f"step {num_steps} of episode {episode_id} was not seen"
        if step.images is None or step.next_images is None:
            episode.fault = episode.fault or f"no image of step {step.episode_steps[n]} of episode {episode_id}"
        else:
            episode.frames += [images[n].copy() for images in (step.images, step.next_images)[int(num_steps > 0) :]]
        episode.actions.append(step.actions[n].copy())
        if step.goals is not None and step.goals[1][n]:
            episode.goal = step.goals[0][n]
        return episode

    def _job(self, episode: _Episode, spec: EnvironmentSpec, session: int) -> ClipJob:
        frames = np.stack(episode.frames)
        clip_id = f"episode {episode.episode_id} of session {session}"
        task = TaskSpec(
            spec.instruction, spec.task, self._judge.settings.robot, frames[0], episode.goal, np.stack(episode.actions)
        )
        return ClipJob(clip_ref(clip_id, frames, 1 / spec.control_period_s), task)
