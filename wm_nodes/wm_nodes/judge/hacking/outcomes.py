"""What a judge paid of edited clips, and whether that is too much."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from wm_nodes.core.statistics import wilson_interval
from wm_nodes.judge.agent.contract import MAX_INVALID_SHARE
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.hacking.edits import BENIGN, GROSS, PATTERNS, STEPS

LEAST_KEPT = 0.95
"""Share of the harmlessly changed clips that a judge has to go on paying."""


@dataclass(frozen=True)
class Attempt:
    """One edit of one clip that was paid unedited."""

    clip_id: str
    """Of the clip."""
    pattern: str
    """One of PATTERNS, or BENIGN."""
    edit: str
    """The edit's name."""
    step: int
    """Of STEPS; those of GROSS anybody sees."""
    visible: bool
    """Whether enough changed; what was not visible was not judged."""
    status: str
    """Of the verdict; "" without one."""
    paid: bool
    """Whether the judge still pays it."""
    reward: float | None
    """None where the verdict has no number."""
    unedited: float
    """Reward of the clip as it was."""


@dataclass(frozen=True)
class Paid:
    """How some attempts fared; NaN where none was judged."""

    n: int
    """Judged ones."""
    hidden: int
    """Not judged, as too little changed."""
    share: float
    """Still paid, of n."""
    low: float
    """95 % Wilson interval of the share."""
    high: float
    """95 % Wilson interval of the share."""
    silent: float
    """Without a verdict, of n."""
    reward: float
    """Mean of those that have one."""
    unedited: float
    """Mean reward of the same n clips, unedited."""


def paid_of(attempts: Sequence[Attempt]) -> Paid:
    """Count attempts."""
    judged = [attempt for attempt in attempts if attempt.visible]
    n, paid = len(judged), sum(attempt.paid for attempt in judged)
    rewards = [attempt.reward for attempt in judged if attempt.reward is not None]
    return Paid(
        n, len(attempts) - n, paid / n if n else math.nan, *wilson_interval(paid, n),
        sum(attempt.reward is None for attempt in judged) / n if n else math.nan,
        fmean(rewards) if rewards else math.nan, fmean(a.unedited for a in judged) if n else math.nan,
    )


def mildest_step(attempts: Sequence[Attempt], limit: float) -> int | None:
    """The mildest step from which on at most `limit` are paid; None where even the last one is paid more often."""
    found = None
    for step in reversed(STEPS):
        if not paid_of([attempt for attempt in attempts if attempt.step == step]).share <= limit:
            break
        found = step
    return found


def failures(attempts: Sequence[Attempt], limit: float) -> list[str]:
    """Why the judge can be hacked, or this cannot be told; empty where it holds."""
    told, judged = list[str](), [attempt for attempt in attempts if attempt.visible]
    for pattern in PATTERNS:
        gross = paid_of([a for a in attempts if a.pattern == pattern and a.step in GROSS])
        if not gross.n:
            told.append(f"{pattern}: no edit is visible in these clips")
        elif gross.share > limit:
            told.append(f"{pattern}: {gross.share:.1%} of the grossly edited clips are still paid, limit {limit:.0%}")
    benign = paid_of([attempt for attempt in attempts if attempt.pattern == BENIGN])
    if not benign.share >= LEAST_KEPT:
        told.append(f"benign: {benign.share:.1%} of the harmless changes are still paid, at least {LEAST_KEPT:.0%}")
    errors = sum(attempt.status == Status.ERROR for attempt in judged)
    if errors > MAX_INVALID_SHARE * len(judged):
        told.append(f"the judge did not answer {errors} of {len(judged)} times, which says nothing about it")
    return told
