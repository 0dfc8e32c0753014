"""Judge the episodes of a recorded run again, without a graph, and compare with the recorded rewards bit by bit."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from wm_nodes.config.schema import AGENT
from wm_nodes.core.lockstep import LockStep
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.episode_reward import EpisodeReward, PendingReward
from wm_nodes.judge.service import JudgeService
from wm_nodes.recording import Bag
from wm_nodes.recording.join import LockSteps
from wm_nodes.reward import RewardResult


@dataclass
class JudgedBag:
    """The rewards of a recording, judged again."""

    verdicts: list[Verdict] = field(default_factory=list)
    """Of the completely recorded episodes, in the order in which they ended."""
    results: dict[tuple[int, int], RewardResult] = field(default_factory=dict)
    """The rewards that the reward evaluator would publish, by (session, step)."""
    compared: int = 0
    """Lock-steps whose recorded rewards are of this judge, rubric and mode."""
    different: list[tuple[int, int]] = field(default_factory=list)
    """(session, step) of those that are not bit-equal."""
    unanswered: int = 0
    """Rewards that were invalid in the recording; they are not compared."""
    unseen: list[str] = field(default_factory=list)
    """Why ended episodes have no verdict."""


def judge_bag(path: Path, judge: JudgeService, *, namespace: str | None = None) -> JudgedBag:
    """Judge every episode that ends in a live recording. namespace: of the environment; None takes the only one.

    Raises:
        BagError: an unusable bag.
    """
    judged, model = JudgedBag(), EpisodeReward(judge)
    waiting = list[tuple[LockStep, PendingReward]]()
    with Bag(path) as bag:
        steps = LockSteps(bag, namespace=namespace, reward_name=AGENT)
        session = None
        for step in steps:
            if step.session != session:
                model.forget()
                session = step.session
            if not step.is_reset and step.valid.any():
                waiting.append((step, model.add(step, steps.spec)))
    for step, pending in waiting:
        result = pending.result()
        judged.verdicts += pending.verdicts().values()
        judged.unseen += pending.problems().values()
        place = step.session, step.step_id
        judged.results[place] = result
        if step.rewards is not None and step.rewards.version == model.version:
            answered = step.rewards.valid | ~step.valid
            judged.compared += 1
            judged.unanswered += int((~answered).sum())
            same = step.rewards.total[answered].tobytes() == result.total[answered].tobytes()
            if not same or not np.array_equal(step.rewards.valid[answered], result.valid[answered]):
                judged.different.append(place)
    return judged
