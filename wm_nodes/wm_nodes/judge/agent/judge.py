"""The interface of a judge: what it is asked, what it answers, what it costs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal, Protocol

from wm_nodes.judge.agent.types import ClipRef, Component, Profile, Stage, Status, TaskSpec


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
    """How a component is asked. json: evidence first, then a level. label: one token, probabilities per option. truth:
    one token, the probability of "True" (topreward.py).

    negative: "which defect is visible", options listed worst first. positive: options in the order of `seed`.
    levels.option_order gives the order, levels.map_back undoes it. index: 0 is the first read of a stage.
    """

    index: int
    kind: Literal["json", "label", "truth"]
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
    source: Literal["json", "label", "embedded", "human"]
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
    deterministic: equal requests get equal answers. card: its measured abilities as text; "" without a measurement.
    """

    judge_id: str
    transport: str
    model: str
    server_version: str
    components: frozenset[Component] | None = None
    max_frames: int = 64
    deterministic: bool = False
    card: str = ""


@dataclass(frozen=True)
class Health:
    """Whether a judge answers now. details: measured numbers by name (invalid rate, cached ratio, latency s)."""

    available: bool
    reason: str = ""
    details: Mapping[str, float] = field(default_factory=dict)


def reads_of(request: ReadRequest, cost: Cost, answer: Callable[[Component], Read]) -> list[Read]:
    """The reads of a judge that answers every vote of a component alike; the first one carries the cost."""
    reads = list[Read]()
    for name in request.components:
        said = answer(name)
        reads += [replace(said, component=name, vote=vote, cost=Cost()) for vote in request.votes]
    return [replace(reads[0], cost=cost), *reads[1:]] if reads else []


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
