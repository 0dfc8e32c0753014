"""Rollouts back out of a live recording of training. Suffix TN: T lock-steps, N environments."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.core.specs import POLICY_FIELDS, EnvironmentSpec
from wm_nodes.core.types import Rollout
from wm_nodes.recording import topics
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.lockstep import LockSteps, RecordedStep
from wm_nodes.recording.reader import BagReport, check_spec


def read_rollouts(
    path: Path, *, num_steps: int | None = None, expected: EnvironmentSpec | None = None, namespace: str | None = None,
    report: BagReport | None = None,
) -> Iterator[Rollout]:
    """Yield the rollouts of a live recording of training, in order: the lock-steps between two env/reset calls or
    changes of policy_version.

    valid is the transition's and the reward's; the reward of an invalid entry is what the evaluator published.

    Args:
        num_steps: lock-steps per rollout; others are incomplete. None takes any length.
        expected: refuse a bag of another camera, size, action or state than this spec.
        report: given, rollouts that lost a step, an image or a reward are counted there; else they raise.

    Raises:
        BagError: names the value and the remedy.
    """
    notes = report if report is not None else BagReport()
    with Bag(path) as bag:
        steps = LockSteps(bag, namespace=namespace)
        if expected is not None:
            check_spec(steps.spec, expected, where=str(path), names=POLICY_FIELDS)
        if not bag.count(topics.absolute(steps.namespace, topics.REWARD)):
            raise BagError(f"bag {path} has no rewards; record the topic {topics.REWARD.name}, or re-evaluate them")
        for group in _rollout_groups(steps):
            problem = _rollout_problem(group, num_steps)
            if not problem:
                notes.yielded += 1
                yield _rollout(group)
                continue
            text = f"rollout of policy_version {_version(group[0])} from step_id {group[0].step_id}: {problem}"
            if report is None:
                raise BagError(f"{text} in {path}; pass report=BagReport() to leave such rollouts out and count them")
            notes.incomplete.append(text)
        notes.lost_steps += steps.lost


def recorded_reward_name(path: Path, *, namespace: str | None = None) -> str:
    """The reward model of a live recording's first rewards; "" where it has none. Raises BagError: an unusable bag."""
    with Bag(path) as bag:
        name = topics.absolute(bag.namespace(namespace), topics.REWARD)
        for _, _, data in bag.messages([name]) if bag.count(name) else ():
            return str(bag.decode(data, topics.REWARD.msgtype).reward_name)
    return ""


def _rollout_groups(steps: LockSteps) -> Iterator[list[RecordedStep]]:
    group: list[RecordedStep] = []
    for step in steps:
        starts_new = step.is_reset or (
            bool(group) and (step.session, _version(step)) != (group[0].session, _version(group[0]))
        )
        if starts_new and group:
            yield group
            group = []
        if not step.is_reset:
            group.append(step)
    if group:
        yield group


def _version(step: RecordedStep) -> int:
    return int(step.policy_version.max())


def _rollout_problem(group: list[RecordedStep], num_steps: int | None) -> str:
    if num_steps is not None and len(group) != num_steps:
        return f"{len(group)} lock-steps instead of {num_steps}"
    for previous, step in pairwise(group):
        if step.step_id != previous.step_id + 1:
            return f"step_id {previous.step_id + 1} is missing"
    for step in group:
        if step.images is None or step.next_images is None:
            return f"an image of step_id {step.step_id} is missing"
        if step.reward is None and step.valid.any():
            return f"the reward of step_id {step.step_id} is missing"
    return ""


def _rollout(group: list[RecordedStep]) -> Rollout:
    def stack(name: str) -> Any:
        return np.stack([getattr(step, name) for step in group])

    blank = np.zeros(len(group[0].valid), np.float32)
    rewards = [step.reward.total if step.reward is not None else blank for step in group]
    reward_valid = [step.reward.valid if step.reward is not None else blank.astype(bool) for step in group]
    return Rollout(
        images_TN=stack("images"), states_TN=stack("states"), next_images_TN=stack("next_images"),
        next_states_TN=stack("next_states"), actions_TN=stack("actions"), logprobs_TN=stack("logprobs"),
        values_TN=stack("values"), rewards_TN=np.stack(rewards), terminated_TN=stack("terminated"),
        truncated_TN=stack("truncated"), valid_TN=stack("valid") & np.stack(reward_valid),
        policy_version=_version(group[0]),
    )
