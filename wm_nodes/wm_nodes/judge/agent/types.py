"""Requests, answers, scores and verdicts of the reward agent and its judges.

Shapes: T frames, H W 3 image, A action. A component (clarity, robot, ...) is a name that the rubric pack defines, so
that another domain adds its own without code. Levels of a component: 0 unusable, 1 clearly wrong, 2 borderline,
3 minor flaw, 4 clean. Levels of planning: 0 invalid, 1 poor, 2 fair, 3 good. Hack patterns are read on the same five
levels: 0 surely present, 4 surely absent.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import FloatArray, UInt8Array

NUM_LEVELS = 5
NUM_PLAN_LEVELS = 4
PLANNING = "planning"
"""The one component of Stage.PLAN; its distribution has NUM_PLAN_LEVELS entries."""

Component = str


class Stage(StrEnum):
    """What a read is for. VQ, IF, TC, PC are scored and gated, in this order."""

    PLAN = "PLAN"
    VQ = "VQ"
    IF = "IF"
    TC = "TC"
    PC = "PC"
    HACK = "HACK"
    REFLECT = "REFLECT"


GATED = (Stage.VQ, Stage.IF, Stage.TC, Stage.PC)


class Status(StrEnum):
    """OK: there is a number. SKIPPED: not read. ABSTAIN: read, but undecided. ERROR: no answer."""

    OK = "OK"
    SKIPPED = "SKIPPED"
    ABSTAIN = "ABSTAIN"
    ERROR = "ERROR"


class Profile(StrEnum):
    """Which frames a read sees (RA-3): static, instruction, end, dense."""

    S = "S"
    I = "I"  # noqa: E741
    E = "E"
    D = "D"


@dataclass(frozen=True, eq=False)
class ClipRef:
    """A clip to judge. frames: uint8 (T, H, W, 3), RGB; fps > 0. Nothing is checked here: PRECHECK says what is wrong.

    sha256: of shape, fps and pixels, see clip_ref.
    """

    clip_id: str
    sha256: str
    frames: UInt8Array
    fps: float
    source: Literal["rollout", "real", "adversarial"] = "rollout"

    @property
    def duration_s(self) -> float:
        return len(self.frames) / self.fps


def clip_ref(
    clip_id: str, frames: UInt8Array, fps: float, source: Literal["rollout", "real", "adversarial"] = "rollout"
) -> ClipRef:
    """Name a clip by its content."""
    return ClipRef(clip_id, media_sha(np.asarray(frames), fps), frames, fps, source)


def media_sha(frames: NDArray[Any], fps: float) -> str:
    """SHA-256, hexadecimal, of dtype, shape, fps and pixels."""
    head = f"{frames.dtype.str} {frames.shape} {fps!r} ".encode()
    return hashlib.sha256(head + np.ascontiguousarray(frames).tobytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """What the clip should show. reference_frame: uint8 (H, W, 3), the conditioning image. goal_image: the same shape.
    actions: float32 (T - 1, A), action t moves frame t to frame t + 1; None where nobody knows.
    """

    instruction: str
    task_id: str
    robot: str
    reference_frame: UInt8Array
    goal_image: UInt8Array | None = None
    actions: FloatArray | None = None
    camera_id: str = ""


Evidence = Mapping[str, float]
"""Endogenous signals by name (RA-17). They trigger a second look and never add reward."""


@dataclass(frozen=True)
class Cost:
    """Cost of some reads. images: sent. cached_tokens: part of prompt_tokens. usd: None where no price is known."""

    calls: int = 0
    prompt_tokens: int = 0
    cached_tokens: int = 0
    completion_tokens: int = 0
    images: int = 0
    wall_s: float = 0.0
    retries: int = 0
    usd: float | None = None

    def __add__(self, other: "Cost") -> "Cost":
        """Sum field by field; the usd of both where either is known."""
        known = [cost.usd for cost in (self, other) if cost.usd is not None]
        numbers = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self) if f.name != "usd"}
        return Cost(**numbers, usd=sum(known) if known else None)


@dataclass(frozen=True)
class Vote:
    """How a component is asked. json: evidence first, then a level. label: one token, probabilities per option.

    negative: "which defect is visible", options listed worst first. positive: options in the order of `seed`.
    levels.option_order gives the order, levels.map_back undoes it. index: 0 is the first read of a stage.
    """

    index: int
    kind: Literal["json", "label"]
    polarity: Literal["positive", "negative"]
    seed: int


@dataclass(frozen=True)
class Read:
    """One judge's answer on one component, to one vote.

    levels: probability of each level, worst first, whatever the order of the options was; sums to 1. Empty unless OK.
        A JSON answer without probabilities is one-hot.
    label_mass: probability of all options together before normalising; 1 for JSON and under a choice grammar.
    status: OK; ABSTAIN (out of distribution, says `reason`); ERROR (no valid answer after the judge's retries).
    frames_cited: clip frame indices. focus: for planning, components with a visible problem, worst first.
    cost: this read's part of its call; the reads of one call together cost the call.
    prompt_sha, media_sha: SHA-256 of what was sent; "" where nothing was (embedded).
    """

    component: Component
    levels: tuple[float, ...]
    source: Literal["json", "label", "decision", "embedded", "human"]
    vote: Vote
    label_mass: float = 1.0
    status: Status = Status.OK
    reason: str = ""
    evidence_text: str = ""
    frames_cited: tuple[int, ...] = ()
    focus: tuple[Component, ...] = ()
    cost: Cost = Cost()
    prompt_sha: str = ""
    media_sha: str = ""


@dataclass(frozen=True)
class ComponentScore:
    """s in [0, 1], p_fail in [0, 1] and margin in [0, 1] of the pooled votes; NaN unless status is OK.

    decided_by: "first read", "2 of 3 votes", "reflection", "cap by occlusion", ... evidence_text and frames_cited: of
    the first read that has some.
    """

    component: Component
    status: Status
    s: float
    p_fail: float
    margin: float
    votes: tuple[Read, ...]
    decided_by: str
    reason: str = ""

    @property
    def evidence_text(self) -> str:
        return next((read.evidence_text for read in self.votes if read.evidence_text), "")

    @property
    def frames_cited(self) -> tuple[int, ...]:
        return next((read.frames_cited for read in self.votes if read.frames_cited), ())

    @property
    def passed(self) -> bool:
        """p_fail < 0.5. False where there is no number."""
        return self.p_fail < 0.5


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
    """Origin of a verdict. prompt_sha: over the prompts of all reads. started, ended: Unix time, s."""

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
    PRECHECK found no video, -1 without planning. stages: VQ, IF, TC, PC. reason: of any status but OK. audit_id:
    content hash without times, equal for equal seeds and equal answers of the judge.
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
    return hashlib.sha256(json.dumps(_plain(asdict(verdict)), sort_keys=True, allow_nan=False).encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items() if key not in MEASURED}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class MediaItem:
    """One image of a read. clip: frame `index` of the clip at `time_s`. reference, goal: the task's image, index -1."""

    kind: Literal["clip", "reference", "goal"]
    index: int = -1
    time_s: float = 0.0

    @property
    def label(self) -> str:
        """The text in front of the image, so that citations can be checked."""
        return f"frame {self.index} at {self.time_s:.2f} s" if self.kind == "clip" else f"{self.kind} image"


@dataclass(frozen=True, eq=False)
class ReadRequest:
    """A question to a judge: every component of `components`, asked once per vote; one Read each, in any order.

    media: the images in the order they are sent (profiles.py); of one profile, or the cited frames of a fresh look.
    mode: pack (one call for all components), fanout (one each), auto (the judge decides by its measured cache).
    prior: for REFLECT, what was found so far; it goes last in the prompt, and never into a first read.
    """

    clip: ClipRef
    task: TaskSpec
    stage: Stage
    components: tuple[Component, ...]
    profile: Profile
    votes: tuple[Vote, ...]
    media: tuple[MediaItem, ...]
    mode: Literal["pack", "fanout", "auto"] = "auto"
    prior: Sequence[ComponentScore] = ()


@dataclass(frozen=True)
class Capabilities:
    """What a judge can do. components: those it reads, None for all of the rubric. max_frames: images per call.
    probabilities: label votes are not one-hot. reasons: it gives evidence texts. deterministic: equal requests get
    equal answers. card: its measured abilities as text; "" without a measurement.
    """

    judge_id: str
    transport: str
    model: str
    server_version: str
    components: frozenset[Component] | None = None
    media: frozenset[Literal["image", "video"]] = frozenset({"image"})
    max_frames: int = 64
    probabilities: bool = True
    reasons: bool = True
    deterministic: bool = False
    card: str = ""


@dataclass(frozen=True)
class Health:
    """Whether a judge answers now. details: measured numbers by name (invalid rate, cached ratio, latency s)."""

    available: bool
    reason: str = ""
    details: Mapping[str, float] = field(default_factory=dict)


class JudgeError(Exception):
    """No read of a request was answered, after the judge's own retries. cost: of the attempts."""

    def __init__(self, reason: str, cost: Cost | None = None) -> None:
        super().__init__(reason)
        self.cost = cost or Cost()


class Judge(Protocol):
    """Reads clips: a server, an embedded model, an audit log or people."""

    @property
    def capabilities(self) -> Capabilities: ...

    async def read(self, request: ReadRequest) -> list[Read]:
        """Answer every component once per vote. A component that failed has a Read with status ERROR and a reason.

        Raises:
            JudgeError: nothing at all could be answered.
        """
        ...

    async def health(self) -> Health: ...
