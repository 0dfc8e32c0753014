"""A judge that knows the labels of clips and errs at a known rate: a control of the agent, never a reward."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.agent.judge import Capabilities, Health, Read, ReadRequest
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import NUM_LEVELS, NUM_PLAN_LEVELS, PLANNING, Stage

CLEAN, WRONG, ABSENT, PRESENT = 4, 1, 4, 0
"""Levels of a component that passes and of one that fails, of a pattern that is not there and of one that is."""
SHARED, FIRST_VOTE, SECOND_LOOK, NUM_DRAWS = 0, 1, 8, 9
"""Draws of a component of a clip: the shared one, those of votes 0 to 6, that of reflection's second look."""


@dataclass(frozen=True)
class ClipLabels:
    """What the judge knows of a clip."""

    passed: Mapping[str, bool | None]
    """By component; where it is None or missing nobody knows, and the judge sees no fault."""
    planning: int
    """Level 0 to 3."""
    completion: int
    """Level 0 to 4."""
    patterns: frozenset[str] = frozenset()
    """Hacking patterns that are there."""


@dataclass(frozen=True)
class Errors:
    """How a judge errs.

    Raises:
        ValueError: rate is outside [0, 0.5], or shared outside [0, 1].
    """

    rate: float = 0.0
    """Share of reads that are wrong."""
    shared: float = 0.0
    """Correlation of the errors of two reads of one component of one clip; at 1 all votes and second looks repeat one
    answer."""
    honest: bool = False
    """A read is as sure as it is often right; else always sure."""

    def __post_init__(self) -> None:
        if not (0 <= self.rate <= 0.5 and 0 <= self.shared <= 1):
            raise ValueError(f"rate must lie in [0, 0.5] and shared in [0, 1], got {self}")


class LabelJudge:
    """Answers from the labels of clips, by their SHA-256.

    With probability `shared` all reads of a component of a clip use one draw, else each read has its own. A draw is
    wrong with probability q: the rate, or u^(1 / (2 rate) - 1) / 2 of a uniform u, whose mean is the rate, where
    honest. A wrong component or pattern says the contrary; a wrong level of planning or task completion is one or two
    off. The answer has probability 1 - q where honest, what else it could have said has q. Equal seeds draw equally
    whatever the errors, so that settings are compared in pairs.

    Raises:
        ValueError: at a read, a clip it does not know.
    """

    def __init__(
        self, clips: Mapping[str, ClipLabels], rubric: Rubric, errors: Errors | None = None, *, seed: int = 0
    ) -> None:
        self.clips, self.errors, self._seed = dict(clips), errors or Errors(), seed
        graded = rubric.stages[Stage.TC].components if Stage.TC in rubric.stages else ()
        self._graded, self._components = (PLANNING, *graded), (PLANNING, *rubric.component_names)
        self._patterns = tuple(rubric.hack.patterns)
        self._drawn: dict[str, FloatArray] = {}
        self._labels = hashlib.sha256(repr(sorted(clips.items())).encode()).hexdigest()[:8]

    @property
    def capabilities(self) -> Capabilities:
        model = f"labels {self._labels}, {self.errors}, seed {self._seed}"
        names = frozenset({*self._components, *self._patterns})
        return Capabilities("labels", "none", model, "2", names)

    async def health(self) -> Health:
        return Health(True)

    async def read(self, request: ReadRequest) -> list[Read]:
        if request.clip.sha256 not in self.clips:
            raise ValueError(f"clip {request.clip.clip_id} has no labels; this judge knows the clips of its set only")
        cited = (0,) if request.stage is Stage.REFLECT else ()
        return [
            Read(
                name, self._levels(request, name, vote.index), "json" if vote.kind == "json" else "label", vote,
                frames_cited=cited,
            )
            for name in request.components for vote in request.votes
        ]

    def _levels(self, request: ReadRequest, name: str, vote: int) -> tuple[float, ...]:
        is_pattern = request.stage is Stage.HACK
        row = len(self._components) + self._patterns.index(name) if is_pattern else self._components.index(name)
        draws = self._draws(request.clip.sha256)[row]
        own = SECOND_LOOK if request.stage is Stage.REFLECT else FIRST_VOTE + vote
        sureness, fault, offset = draws[SHARED if draws[SHARED, 3] < self.errors.shared else own, :3]
        rate, honest = self.errors.rate, self.errors.honest and self.errors.rate > 0
        q = sureness ** (0.5 / rate - 1) / 2 if honest else rate
        truth, other = self._answers(self.clips[request.clip.sha256], name, is_pattern, offset)
        said, unsaid = (other, truth) if fault < q else (truth, other)
        levels = [0.0] * (NUM_PLAN_LEVELS if name == PLANNING else NUM_LEVELS)
        levels[said], levels[unsaid] = (1 - q, q) if honest else (1.0, 0.0)
        return tuple(levels)

    def _answers(self, labels: ClipLabels, name: str, is_pattern: bool, offset: float) -> tuple[int, int]:
        """The true level and the one that an error says. offset: uniform in [0, 1), which of the levels near it."""
        if is_pattern:
            return (PRESENT, ABSENT) if name in labels.patterns else (ABSENT, PRESENT)
        if name not in self._graded:
            return (WRONG, CLEAN) if labels.passed.get(name) is False else (CLEAN, WRONG)
        truth, count = (labels.planning, NUM_PLAN_LEVELS) if name == PLANNING else (labels.completion, NUM_LEVELS)
        near = [level for level in range(count) if 0 < abs(level - truth) <= 2]
        return truth, near[int(offset * len(near))]

    def _draws(self, sha256: str) -> FloatArray:
        """Uniform in [0, 1), (component, draw, what for)."""
        if sha256 not in self._drawn:
            shape = (len(self._components) + len(self._patterns), NUM_DRAWS, 4)
            self._drawn[sha256] = numpy_stream(self._seed, f"labels/{sha256}").random(shape, np.float32)
        return self._drawn[sha256]
