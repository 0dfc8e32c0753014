"""Rollouts back out of a live recording of training. Suffix TN: T lock-steps, N environments."""

from collections.abc import Iterator
from pathlib import Path

from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Rollout
from wm_nodes.recording import topics
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.join import LockSteps, begins_rollout, rollout_of, rollout_problem, version_of
from wm_nodes.recording.reader import BagReport, check_spec


def read_rollouts(
    path: Path, *, num_steps: int | None = None, expected: EnvironmentSpec | None = None, namespace: str | None = None,
    report: BagReport | None = None,
) -> Iterator[Rollout]:
    """Yield the rollouts of a live recording of training, in order: the lock-steps between two env/reset calls or
    changes of policy_version.

    valid and rewards are as of join.rollout_of.

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
            check_spec(steps.spec, expected, where=str(path))
        if not bag.count(topics.absolute(steps.namespace, topics.REWARD)):
            raise BagError(f"bag {path} has no rewards; record the topic {topics.REWARD.name}, or re-evaluate them")
        for group in _rollout_groups(steps):
            version = version_of(group[0])
            problem = rollout_problem(group, num_steps)
            if not problem:
                notes.yielded += 1
                yield rollout_of(group, version)[0]
                continue
            text = f"rollout of policy_version {version} from step_id {group[0].step_id}: {problem}"
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


def _rollout_groups(steps: LockSteps) -> Iterator[list[LockStep]]:
    group: list[LockStep] = []
    for step in steps:
        if group and begins_rollout(step, group[0]):
            yield group
            group = []
        if not step.is_reset:
            group.append(step)
    if group:
        yield group
