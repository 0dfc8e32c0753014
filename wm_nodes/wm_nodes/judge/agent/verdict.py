"""The result of the reward agent for one clip: scores of stages, reflections, hacking patterns, origin."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any

from wm_nodes.judge.agent.judge import ComponentScore, Cost
from wm_nodes.judge.agent.types import Component, Stage, Status


@dataclass(frozen=True)
class StageScore:
    """A gated stage."""

    stage: Stage
    """One of GATED."""
    status: Status
    """OK, or why there is no number."""
    s: float
    """In [0, 1], NaN unless OK."""
    passed: bool
    """s >= theta and no veto."""
    components: tuple[ComponentScore, ...] = ()
    """What it is made of."""
    vetoed_by: str = ""
    """A component, or "hack" and a pattern; "" without a veto."""


@dataclass(frozen=True)
class PlanResult:
    """The first look at the whole clip."""

    p_level: tuple[float, ...]
    """(4,), probabilities of L0 to L3."""
    level: int
    """The likeliest."""
    weights: Mapping[Stage, float]
    """Of VQ, IF, TC, PC, as the reward uses them."""
    focus: tuple[Component, ...]
    """Up to three components to vote first."""
    reason: str
    """In words."""


@dataclass(frozen=True)
class Change:
    """A component as reflection sees it."""

    component: Component
    """Its name."""
    before: float
    """s as it was."""
    after: float
    """s as proposed."""
    reason: str
    """In words."""
    frames: tuple[int, ...]
    """Cited ones."""
    accepted: bool
    """A fresh label read on `frames` agreed."""


@dataclass(frozen=True)
class Reflection:
    """One second look. triggers: why, in words. changed: what it proposed."""

    triggers: tuple[str, ...]
    changed: tuple[Change, ...] = ()

    @property
    def accepted(self) -> bool:
        return any(change.accepted for change in self.changed)


@dataclass(frozen=True)
class HackFlag:
    """One hacking pattern (RA-12)."""

    pattern: str
    """Its name."""
    p_present: float
    """Probability that it is there."""
    confirmed: bool
    """Two reads agree; only then it caps."""
    evidence_text: str = ""
    """What was seen."""


@dataclass(frozen=True)
class Provenance:
    """Origin of a verdict."""

    judge_id: str
    """Who judged."""
    transport: str
    """How it was asked."""
    model: str
    """Its name."""
    server_version: str
    """"" where unknown."""
    rubric_version: str
    """Of the words of its questions (RewardAgent.version)."""
    prompt_sha: str
    """Over the prompts of all reads."""
    media_sha: str
    """Of the clip."""
    seed: int
    """Of option orders and audits."""
    started: float
    """Unix time, s."""
    ended: float
    """Unix time, s."""


@dataclass(frozen=True)
class Verdict:
    """The agent's result for one clip."""

    clip_id: str
    """Its name."""
    status: Status
    """OK, or why there is no reward."""
    reward: float
    """In [0, 1], NaN unless status is OK."""
    level: int
    """Planning level; 0 where PRECHECK found no video, -1 without planning."""
    stages: tuple[StageScore, ...]
    """VQ, IF, TC, PC; TC alone in mode topreward."""
    plan: PlanResult | None
    """None without planning."""
    reflections: tuple[Reflection, ...]
    """Second looks."""
    hack_flags: tuple[HackFlag, ...]
    """Of the patterns that were read."""
    cost: Cost
    """Of all reads."""
    provenance: Provenance
    """Where it comes from."""
    reason: str = ""
    """Of any status but OK."""
    num_reads: int = 0
    """Components that were asked, each time counted."""
    audit_id: str = ""
    """Content hash without times, equal for equal seeds and equal answers of the judge."""

    @property
    def valid(self) -> bool:
        return self.status is Status.OK


MEASURED = frozenset({"cost", "started", "ended", "audit_id"})
"""Fields that differ between equal runs: clocks, caches and retries are no part of what was judged."""


def content_hash(verdict: Verdict) -> str:
    """SHA-256, hexadecimal, of a verdict as canonical JSON without what is MEASURED; NaN counts as null."""
    return hashlib.sha256(json.dumps(_plain(verdict), sort_keys=True, allow_nan=False).encode()).hexdigest()


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, (str, int)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items() if key not in MEASURED}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
