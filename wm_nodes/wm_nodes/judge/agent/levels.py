"""From answers on five levels to one score: option order, pooling, majority (RA-5 to RA-8).

p is a distribution over levels 0..4, worst first. s = sum_l l p_l / 4; p_fail = p_0 + p_1 + p_2 / 2.
"""

import hashlib
import math
from collections.abc import Sequence

import numpy as np

from wm_nodes.judge.agent.judge import ComponentScore, Read, Vote
from wm_nodes.judge.agent.types import NUM_LEVELS, Component, Status

SUM_TOLERANCE = 1e-6

Levels = tuple[float, ...]


def first_vote(seed: int) -> Vote:
    """Vote 0: a JSON call with its evidence sentence."""
    return Vote(0, "json", "positive", seed)


def next_vote(index: int, seed: int) -> Vote:
    """A label read: votes 1, 3, .. negative, worst first; votes 2, 4, .. positive, options in seeded order."""
    return Vote(index, "label", "negative" if index % 2 else "positive", seed)


def option_order(vote: Vote, clip_sha: str, component: Component, num_levels: int = NUM_LEVELS) -> tuple[int, ...]:
    """Which level each listed option stands for: worst first for the negative question, else seeded by content."""
    if vote.polarity == "negative" or vote.kind == "json":
        return tuple(range(num_levels))
    text = f"{vote.seed}/{clip_sha}/{component}/{vote.index}"
    seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
    return tuple(int(level) for level in np.random.default_rng(seed).permutation(num_levels))


def map_back(options: Sequence[float], order: Sequence[int]) -> Levels:
    """Probabilities of levels from those of the options as listed; `order` is option_order's."""
    if sorted(order) != list(range(len(options))):
        raise ValueError(f"order {tuple(order)} is no permutation of the {len(options)} options")
    levels = [0.0] * len(options)
    for probability, level in zip(options, order):
        levels[level] = float(probability)
    return tuple(levels)


def one_hot(level: int, num_levels: int = NUM_LEVELS) -> Levels:
    """A certain answer. Raises ValueError: no such level."""
    if not 0 <= level < num_levels:
        raise ValueError(f"level must be 0 to {num_levels - 1}, got {level}")
    return tuple(float(index == level) for index in range(num_levels))


def score_of(levels: Levels) -> float:
    """s in [0, 1]."""
    return math.fsum(level * p for level, p in enumerate(levels)) / (len(levels) - 1)


def p_fail_of(levels: Levels) -> float:
    """Probability of a failing level; half of what is borderline. Five levels only."""
    return levels[0] + levels[1] + levels[2] / 2


def state_of(read: Read, min_label_mass: float, num_levels: int = NUM_LEVELS) -> tuple[Status, str]:
    """Whether a read counts, and if not, why: no valid answer is an ERROR, too little label mass an ABSTAIN."""
    p, name = read.levels, read.component
    if read.status is not Status.OK:
        return read.status, f"{name}: {read.reason or 'no reason given'}"
    if not 0 <= read.label_mass <= 1 + SUM_TOLERANCE:
        return Status.ERROR, f"{name}: label mass {read.label_mass} is outside [0, 1]"
    if read.label_mass < min_label_mass:
        return Status.ABSTAIN, f"{name}: label mass {read.label_mass:.3f} is below {min_label_mass}"
    if len(p) != num_levels:
        return Status.ERROR, f"{name}: {len(p)} levels instead of {num_levels}"
    if not all(math.isfinite(value) and value >= 0 for value in p) or abs(math.fsum(p) - 1) > SUM_TOLERANCE:
        return Status.ERROR, f"{name}: levels {p} are no distribution"
    return Status.OK, ""


def pool(reads: Sequence[Read]) -> Levels:
    """p = sum_j m_j p_j / sum_j m_j, m_j the label mass; in any order of reads. Raises ValueError: no label mass."""
    mass = math.fsum(read.label_mass for read in reads)
    if not mass > 0:
        raise ValueError(f"no label mass in {len(reads)} reads; abstain instead of pooling")
    columns = range(len(reads[0].levels))
    return tuple(math.fsum(read.label_mass * read.levels[i] for read in reads) / mass for i in columns)


def score(reads: Sequence[Read], decided_by: str) -> ComponentScore:
    """The pooled score of OK reads."""
    levels = pool(reads)
    p_fail = p_fail_of(levels)
    return ComponentScore(
        reads[0].component, Status.OK, score_of(levels), p_fail, abs(1 - 2 * p_fail), tuple(reads), decided_by
    )


def unscored_component(reads: Sequence[Read], status: Status, reason: str) -> ComponentScore:
    """A component without a number, and why."""
    nan = math.nan
    return ComponentScore(reads[0].component, status, nan, nan, nan, tuple(reads), "nothing", reason)


def settle(reads: Sequence[Read], min_label_mass: float) -> ComponentScore:
    """Decide from these reads alone; ABSTAIN where their majority on pass is not that of the pooled levels."""
    states = [state_of(read, min_label_mass) for read in reads]
    for status in (Status.ERROR, Status.ABSTAIN):
        for state, reason in states:
            if state is status:
                return unscored_component(reads, status, reason)
    passes = sum(p_fail_of(read.levels) < 0.5 for read in reads)
    fails = len(reads) - passes
    pooled = score(reads, "first read" if len(reads) == 1 else f"{max(passes, fails)} of {len(reads)} votes")
    if passes != fails and pooled.passed == (passes > fails):
        return pooled
    reason = f"{reads[0].component}: {passes} votes pass, {fails} fail; the pooled p_fail is {pooled.p_fail:.3f}"
    return unscored_component(reads, Status.ABSTAIN, reason)


def tally(reads: Sequence[Read], *, k: int, k_max: int, min_label_mass: float) -> ComponentScore | None:
    """Decide a component that is voted on, or None: one more vote is needed.

    Stops once the votes still to come of k cannot change the majority, which must be that of the pooled levels; else
    one more vote, up to k_max, then ABSTAIN. A read that does not count (state_of) ends it at once.
    """
    result = settle(reads, min_label_mass)
    if len(reads) >= k_max or any(state_of(read, min_label_mass)[0] is not Status.OK for read in reads):
        return result
    passes = sum(p_fail_of(read.levels) < 0.5 for read in reads)
    decided = abs(2 * passes - len(reads)) > max(0, k - len(reads))
    return result if decided and result.status is Status.OK else None
