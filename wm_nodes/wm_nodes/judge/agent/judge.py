"""The interface of a judge: what it is asked, what it answers, what it costs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal, Protocol

from wm_nodes.judge.agent.types import ClipRef, Component, Profile, Stage, Status, TaskSpec


@dataclass(frozen=True)
class Cost:
    """What some reads cost."""

    calls: int = 0
    """That were answered."""
    prompt_tokens: int = 0
    """Sent."""
    cached_tokens: int = 0
    """Part of prompt_tokens, which the server had."""
    completion_tokens: int = 0
    """Received."""
    images: int = 0
    """Sent."""
    wall_s: float = 0.0
    """With waits and retries."""
    retries: int = 0
    """Requests beyond the first of each call."""

    def __add__(self, other: "Cost") -> "Cost":
        """Sum field by field."""
        return Cost(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})


@dataclass(frozen=True)
class Vote:
    """How a component is asked."""

    index: int
    """0 is the first read of a stage."""
    kind: Literal["json", "label", "truth"]
    """json: evidence first, then a level. label: one token, probabilities per option. truth: one token, the probability
    of "True" (topreward.py)."""
    polarity: Literal["positive", "negative"]
    """negative: "which defect is visible", options listed worst first. positive: options in the order of `seed`.
    levels.option_order gives the order, levels.map_back undoes it."""
    seed: int
    """Of the order of options, and of the request."""


@dataclass(frozen=True)
class Read:
    """One judge's answer on one component, to one vote."""

    component: Component
    """What was asked about."""
    levels: tuple[float, ...]
    """Probability of each level, worst first, whatever the order of the options was; sums to 1. Empty unless OK. A JSON
    answer without probabilities is one-hot."""
    source: Literal["json", "label", "embedded", "human"]
    """How it was answered."""
    vote: Vote
    """How it was asked."""
    label_mass: float = 1.0
    """Probability of all options together before normalising; 1 for JSON and under a choice grammar."""
    status: Status = Status.OK
    """OK; ABSTAIN (out of distribution, says `reason`); ERROR (no valid answer after the judge's retries)."""
    reason: str = ""
    """Of any status but OK."""
    evidence_text: str = ""
    """What the judge saw, in words."""
    frames_cited: tuple[int, ...] = ()
    """Clip frame indices."""
    focus: tuple[Component, ...] = ()
    """For planning, components with a visible problem, worst first."""
    cost: Cost = Cost()
    """This read's part of its call; the reads of one call together cost the call."""
    prompt_sha: str = ""
    """SHA-256 of the question that was sent; "" where nothing was (embedded)."""
    media_sha: str = ""
    """The same of the pictures."""


@dataclass(frozen=True)
class ComponentScore:
    """A component after its votes were pooled."""

    component: Component
    """What was asked about."""
    status: Status
    """OK, or why there is no number."""
    s: float
    """In [0, 1]; NaN unless OK."""
    p_fail: float
    """Probability of a failure, in [0, 1]; NaN unless OK."""
    margin: float
    """How clear that is, in [0, 1]; NaN unless OK."""
    votes: tuple[Read, ...]
    """All reads, in order."""
    decided_by: str
    """"first read", "2 of 3 votes", "reflection", "cap by occlusion", ..."""
    reason: str = ""
    """Of any status but OK."""

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
class MediaItem:
    """One image of a read."""

    kind: Literal["clip", "reference", "goal"]
    """clip: a frame of the clip; reference, goal: the task's image."""
    index: int = -1
    """Of the frame; -1 of the others."""
    time_s: float = 0.0
    """Of the frame in the clip."""

    @property
    def label(self) -> str:
        """The text in front of the image, so that citations can be checked."""
        return f"frame {self.index} at {self.time_s:.2f} s" if self.kind == "clip" else f"{self.kind} image"


@dataclass(frozen=True, eq=False)
class ReadRequest:
    """A question to a judge: every component, asked once per vote; one Read each, in any order."""

    clip: ClipRef
    """To look at."""
    task: TaskSpec
    """What it should show."""
    stage: Stage
    """What the read is for."""
    components: tuple[Component, ...]
    """To be read."""
    profile: Profile
    """Which frames are shown."""
    votes: tuple[Vote, ...]
    """How each is asked."""
    media: tuple[MediaItem, ...]
    """The images in the order they are sent (profiles.py); of one profile, or the cited frames of a fresh look."""
    mode: Literal["pack", "fanout", "auto"] = "auto"
    """pack (one call for all components), fanout (one each), auto (the judge decides by its measured cache)."""
    prior: Sequence[ComponentScore] = ()
    """For REFLECT, what was found so far; it goes last in the prompt, and never into a first read."""


@dataclass(frozen=True)
class Capabilities:
    """What a judge can do."""

    judge_id: str
    """Names judge, model and measurement."""
    transport: str
    """How it is asked."""
    model: str
    """Its name on a server."""
    server_version: str
    """"" where unknown."""
    components: frozenset[Component] | None = None
    """Those it reads; None for all of the rubric."""
    max_frames: int = 64
    """Images per call."""
    card: str = ""
    """Its measured abilities as text; "" without a measurement."""


@dataclass(frozen=True)
class Health:
    """Whether a judge answers now."""

    available: bool
    """It does."""
    reason: str = ""
    """Why not."""
    details: Mapping[str, float] = field(default_factory=dict)
    """Measured numbers by name (invalid rate, cached ratio, latency s)."""


def reads_of(request: ReadRequest, cost: Cost, answer: Callable[[Component], Read]) -> list[Read]:
    """The reads of a judge that answers every vote of a component alike; the first one carries the cost."""
    reads = list[Read]()
    for name in request.components:
        said = answer(name)
        reads += [replace(said, component=name, vote=vote, cost=Cost()) for vote in request.votes]
    return [replace(reads[0], cost=cost), *reads[1:]] if reads else []


class ForwardingJudge:
    """A Judge that hands every question on to another one; a subclass overrides `read`."""

    def __init__(self, judge: "Judge") -> None:
        self._judge = judge

    @property
    def capabilities(self) -> Capabilities:
        return self._judge.capabilities

    async def read(self, request: ReadRequest) -> list[Read]:
        return await self._judge.read(request)

    async def health(self) -> Health:
        return await self._judge.health()


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
        """Answer every component once per vote; failed ones are ERROR with a reason. Raises JudgeError: all failed."""
        ...

    async def health(self) -> Health: ...
