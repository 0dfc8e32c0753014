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
    """A gated stage. s in [0, 1], NaN unless OK. passed: s >= theta and no veto."""

    stage: Stage
    status: Status
    s: float
    passed: bool
    components: tuple[ComponentScore, ...] = ()
    vetoed_by: str = ""


@dataclass(frozen=True)
class PlanResult:
    """p_level: (4,), probabilities of L0 to L3; level: the likeliest. weights: of VQ, IF, TC, PC, as the reward uses
    them. focus: up to three components to vote first.
    """

    p_level: tuple[float, ...]
    level: int
    weights: Mapping[Stage, float]
    focus: tuple[Component, ...]
    reason: str


@dataclass(frozen=True)
class Change:
    """A component as reflection sees it. before, after: s. accepted: a fresh label read on `frames` agreed."""

    component: Component
    before: float
    after: float
    reason: str
    frames: tuple[int, ...]
    accepted: bool


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
    """One hacking pattern (RA-12). confirmed: two reads agree; only then it caps."""

    pattern: str
    p_present: float
    confirmed: bool
    evidence_text: str = ""


@dataclass(frozen=True)
class Provenance:
    """Origin of a verdict. rubric_version: of the words of its questions (RewardAgent.version). prompt_sha: over the
    prompts of all reads. started, ended: Unix time, s.
    """

    judge_id: str
    transport: str
    model: str
    server_version: str
    rubric_version: str
    prompt_sha: str
    media_sha: str
    seed: int
    started: float
    ended: float


@dataclass(frozen=True)
class Verdict:
    """The agent's result for one clip. reward: in [0, 1], NaN unless status is OK. level: planning level; 0 where
    PRECHECK found no video, -1 without planning. stages: VQ, IF, TC, PC; TC alone in mode topreward. reason: of any
    status but OK. audit_id: content hash without times, equal for equal seeds and equal answers of the judge.
    """

    clip_id: str
    status: Status
    reward: float
    level: int
    stages: tuple[StageScore, ...]
    plan: PlanResult | None
    reflections: tuple[Reflection, ...]
    hack_flags: tuple[HackFlag, ...]
    cost: Cost
    provenance: Provenance
    reason: str = ""
    num_reads: int = 0
    audit_id: str = ""

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
