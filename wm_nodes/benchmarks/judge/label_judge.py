"""A judge that knows the labels and errs at a known rate: a control of the benchmark, never a reward.

It shows how the agent works with a judge of a given accuracy: the upper bound of Table 2, what early exits cost and
save, and how far votes correct independent errors.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.agent.judge import Capabilities, Cost, Health, Read, ReadRequest, Vote
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import NUM_PLAN_LEVELS, PLANNING, Component, Stage
from wm_nodes.judge.dataset.edits.clips import TC, ClipTruth, Edit
from wm_nodes.judge.dataset.edits.planning import planning_level

SURE = 0.9
"""Probability that an answer gives to its level; the rest goes to the level beside it."""
CLEAN, WRONG, UNSAID = 4, 1, 2


@dataclass(frozen=True)
class KnownClip:
    labels: ClipTruth
    edits: tuple[Edit, ...]


class LabelJudge:
    """Answers from the labels of known clips. error: probability that a read says the contrary; drawn by clip,
    component and vote, so that votes are independent, which those of a real judge are not.

    Raises:
        ValueError: error is outside [0, 1]; at a read: a clip it does not know.
    """

    def __init__(self, clips: Mapping[str, KnownClip], rubric: Rubric, *, error: float = 0.0, seed: int = 0) -> None:
        if not 0 <= error <= 1:
            raise ValueError(f"error must be a share in [0, 1], got {error}")
        self.clips, self._rubric, self._error, self._seed = dict(clips), rubric, error, seed
        self._labels = hashlib.sha256(repr(sorted(clips.items())).encode()).hexdigest()[:8]

    @property
    def capabilities(self) -> Capabilities:
        names = frozenset({PLANNING, *self._rubric.component_names, *self._rubric.hack.patterns})
        model = f"labels {self._labels}, error {self._error:g}, seed {self._seed}"
        return Capabilities("simulator labels", "none", model, "1", names, reasons=False, deterministic=True)

    async def health(self) -> Health:
        return Health(True)

    async def read(self, request: ReadRequest) -> list[Read]:
        known = self.clips.get(request.clip.sha256)
        if known is None:
            raise ValueError(f"clip {request.clip.clip_id} has no labels; this judge knows the clips of its set only")
        return [self._read(request, known, name, vote) for name in request.components for vote in request.votes]

    def _read(self, request: ReadRequest, known: KnownClip, name: str, vote: Vote) -> Read:
        rng = numpy_stream(self._seed, f"oracle/{request.clip.sha256}/{request.stage}/{name}/{vote.index}")
        errs = bool(rng.random() < self._error)
        if name == PLANNING:
            level = planning_level(known.labels, known.edits)
            level = 2 if level is None else level
            if errs:
                level += 1 if level + 1 < NUM_PLAN_LEVELS else -1
            levels = _spread(level, NUM_PLAN_LEVELS)
        else:
            levels = _spread(self._level(request.stage, known.labels, name, errs), 5)
        cost = Cost(calls=1, images=len(request.media))
        cited = (0,) if request.stage is Stage.REFLECT else ()
        return Read(name, levels, "json" if vote.kind == "json" else "label", vote, frames_cited=cited, cost=cost)

    def _level(self, stage: Stage, labels: ClipTruth, name: Component, errs: bool) -> int:
        if stage is Stage.HACK:
            return CLEAN if (labels.pattern != name) != errs else 0
        if name == TC:
            return 4 - labels.tc_level if errs else labels.tc_level
        passed = labels.passed.get(name)
        if passed is None:
            return UNSAID
        return CLEAN if passed != errs else WRONG


def _spread(level: int, count: int) -> tuple[float, ...]:
    """SURE on the level, the rest on its neighbour: below it from the middle on, so that "borderline" fails."""
    beside = level - 1 if level >= count // 2 else level + 1
    levels = [0.0] * count
    levels[level], levels[beside] = SURE, 1 - SURE
    return tuple(levels)
