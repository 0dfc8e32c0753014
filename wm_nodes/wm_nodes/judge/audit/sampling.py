"""Which clips of a round a person should look at (RA-23).

n = round(200 + 400 (1 - mean reward)): 10 % conflicts, 15 % reflection flips, 20 % near a gate, 15 % of the highest
rewards (hacking lives there), and 40 % plus whatever a stratum lacks at random from all that is left. A clip is in the
first stratum that it fits. First q_s of the N_s clips of every stratum s are drawn, then m of the N - sum q left, so

    P(clip of s is chosen) = q_s / N_s + (1 - q_s / N_s) m / (N - sum q)

exactly, and weighting a label by its inverse keeps totals unbiased.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from wm_nodes.core.files import write_atomic
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.agent.reflection import conflicting
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.audit.log import AuditError
from wm_nodes.judge.audit.reading import Record, RecordedEvaluation

SHARES = {"conflict": 0.10, "reflection": 0.15, "near_gate": 0.20, "top_reward": 0.15}
"""Share of the sample by stratum, in the order in which a clip is put into one. The rest is random."""
REST = "random"
BASE, MORE = 200, 400
NEAR_GATE = 0.1
"""A stage score this near to its threshold, in units of S."""
SECOND_SHARE = 0.2
"""Of the chosen clips, for a second annotator."""


@dataclass(frozen=True)
class SampledClip:
    """A clip to look at."""

    evaluation: int
    """Its number in the log."""
    clip_id: str
    """Of the clip."""
    audit_id: str
    """Of the verdict."""
    stratum: str
    """What it was drawn for."""
    weight: float
    """How many clips of the round it stands for."""
    second: bool
    """A second person should label it too."""


@dataclass(frozen=True)
class Sample:
    """The clips of a round that people should look at."""

    head: str
    """Of the log when it was drawn."""
    round_number: int
    """In the log."""
    seed: int
    """Of the draw."""
    population: int
    """Clips of the round with a verdict."""
    mean_reward: float | None
    """Of those with one; None where no clip has one, which counts as 0 for the size."""
    sizes: dict[str, int]
    """Clips by stratum."""
    chosen: tuple[SampledClip, ...]
    """In the order of the log."""


def sample_size(mean_reward: float, population: int) -> int:
    """Clips to look at: more the lower the reward, and never more than there are."""
    return min(population, round(BASE + MORE * (1 - mean_reward)))


def draw(record: Record, round_number: int, *, seed: int = 0, size: int | None = None) -> Sample:
    """Choose the clips of a round; equal verdicts and seeds give equal choices, whatever order they were judged in.

    Args:
        size: another number of clips than the rule's.

    Raises:
        AuditError: the round has no verdict. ValueError: size < 1.
    """
    pool = sorted(record.judged(round_number), key=lambda e: (e.verdict.audit_id, e.number))
    if not pool:
        rounds = sorted({evaluation.round_number for evaluation in record.judged()})
        raise AuditError(f"{record.folder} has no verdict of round {round_number}; rounds: {rounds or 'none'}")
    if size is not None and size < 1:
        raise ValueError(f"size must be >= 1, got {size}")
    rewards = [e.verdict.reward for e in pool if e.verdict.valid]
    mean = float(np.mean(rewards)) if rewards else None
    count = sample_size(mean or 0.0, len(pool)) if size is None else min(size, len(pool))
    strata = [stratum_of(evaluation, record.rubric(evaluation)) for evaluation in pool]
    strata = _mark_top(pool, strata, round(SHARES["top_reward"] * len(pool)))
    rng = numpy_stream(seed, "audit_sample", round_number)
    drawn, weights, sizes = draw_stratified(strata, count, rng)
    second = set(rng.permutation(drawn)[: round(SECOND_SHARE * len(drawn))].tolist())
    chosen = tuple(
        SampledClip(pool[i].number, pool[i].clip_id, pool[i].verdict.audit_id, strata[i], weights[i], i in second)
        for i in drawn
    )
    return Sample(record.head, round_number, seed, len(pool), mean, sizes, chosen)


def stratum_of(evaluation: RecordedEvaluation, rubric: Rubric) -> str:
    """conflict, reflection, near_gate or, for now, random: the highest rewards need all of the round."""
    verdict = evaluation.verdict
    if verdict.status is Status.ERROR:
        return REST
    passed = {score.component for stage in verdict.stages for score in stage.components if score.passed}
    if verdict.status is Status.ABSTAIN or passed & set(conflicting(evaluation.evidence)):
        return "conflict"
    if any(reflection.accepted for reflection in verdict.reflections):
        return "reflection"
    read = [stage for stage in verdict.stages if stage.status is Status.OK]
    near = any(abs(stage.s - rubric.stages[stage.stage].threshold) <= NEAR_GATE for stage in read)
    return "near_gate" if near else REST


def draw_stratified(
    strata: Sequence[str], count: int, rng: np.random.Generator
) -> tuple[list[int], dict[int, float], dict[str, int]]:
    """Draw `count` of the indices. Returns them in order, their weights, and how many clips each stratum has."""
    members = {name: [i for i, stratum in enumerate(strata) if stratum == name] for name in (*SHARES, REST)}
    quotas = {name: min(round(share * count), len(members[name])) for name, share in SHARES.items()}
    first = [int(i) for name, quota in quotas.items() for i in rng.choice(members[name], quota, replace=False)]
    left = sorted(set(range(len(strata))) - set(first))
    rest = [int(i) for i in rng.choice(left, count - len(first), replace=False)] if left else []
    at_random = len(rest) / len(left) if left else 0.0
    chance = {name: quota / max(1, len(members[name])) for name, quota in quotas.items()} | {REST: 0.0}
    drawn = sorted(first + rest)
    weights = {i: 1 / (chance[strata[i]] + (1 - chance[strata[i]]) * at_random) for i in drawn}
    return drawn, weights, {name: len(indices) for name, indices in members.items()}


def write_sample(path: Path, sample: Sample) -> None:
    write_atomic(path, (json.dumps(asdict(sample), indent=1, allow_nan=False) + "\n").encode())


def read_sample(path: Path) -> Sample:
    """Read a file that write_sample wrote. Raises AuditError: it is none."""
    try:
        return TypeAdapter(Sample).validate_json(Path(path).read_bytes())
    except ValidationError as error:
        raise AuditError(f"{path} is no sample that `sample` wrote: {error.error_count()} faults") from None


def _mark_top(pool: Sequence[RecordedEvaluation], strata: Sequence[str], count: int) -> list[str]:
    """The strata with the `count` highest rewards among the clips of none in top_reward."""
    free = [i for i, e in enumerate(pool) if strata[i] == REST and e.verdict.valid]
    best = sorted(free, key=lambda i: (-pool[i].verdict.reward, i))[:count]
    return ["top_reward" if i in set(best) else stratum for i, stratum in enumerate(strata)]
