"""Judges that answer from a table, for tests of the reward agent: an input given by hand, not a model of a server."""

from collections.abc import Mapping, Sequence

import numpy as np

from wm_nodes.judge.agent.judge import Capabilities, Cost, Health, JudgeError, Read, ReadRequest, Vote
from wm_nodes.judge.agent.levels import map_back, one_hot, option_order
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING, ClipRef, Component, Stage, Status, TaskSpec, clip_ref

CLEAN, FLAWED, BORDERLINE, WRONG, UNUSABLE = (one_hot(level) for level in (4, 3, 2, 1, 0))
GOOD, FAIR, POOR, INVALID = (one_hot(level, 4) for level in (3, 2, 1, 0))

COOKING = """
extends: robot
name: cooking
revision: 3
stages:
  PC:
    components:
      liquid:
        question: Does liquid flow and stay where it should?
        defect: Which impossible flow is visible?
        levels: [solid, frozen in the air, uneven, slight jump, natural]
        weight: 2.0
hack:
  patterns:
    spill:
      question: Is the table dry?
      defect: Is a spill hidden?
      levels: [surely there, probably there, cannot be told, probably not there, surely not there]
      cap: {component: liquid, ceiling: 0.0}
"""
"""A domain's pack: it adds a component and a pattern to the robot pack's."""
Levels = tuple[float, ...]


def make_clip(seed: int = 0, num_frames: int = 16) -> ClipRef:
    """Noise of 8 x 8 pixels at 8 frames per second."""
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, 8, 8, 3), np.uint8)
    return clip_ref(f"clip{seed}", frames, 8.0)


def make_task(clip: ClipRef) -> TaskSpec:
    return TaskSpec("push the red cube to the mark", "push_cube", "panda", clip.frames[0])


def clean_table(rubric: Rubric, **changed: Levels | Sequence[Levels]) -> dict[str, Levels | Sequence[Levels]]:
    """Every component and pattern at level 4 and planning at L3, but for `changed`."""
    return dict.fromkeys((*rubric.component_names, *rubric.hack.patterns), CLEAN) | {PLANNING: GOOD} | changed


class ScriptedJudge:
    """Answers component c to vote j with table[c] or, where that is a list, its entry j (the last one from there on).

    second: what REFLECT answers, by component, citing `cited`; others keep what the table says. label_mass: of label
    votes, by component. Lists its options as option_order says and maps them back. requests: all it was asked.
    """

    def __init__(
        self,
        table: Mapping[str, Levels | Sequence[Levels]],
        *,
        second: Mapping[Component, Levels] | None = None,
        cited: tuple[int, ...] = (1, 2),
        label_mass: Mapping[Component, float] | None = None,
        focus: tuple[Component, ...] = (),
    ) -> None:
        self.table, self.second, self.cited, self.focus = table, second or {}, cited, focus
        self.label_mass = label_mass or {}
        self.requests: list[ReadRequest] = []

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities("scripted", "table", "none", "1", frozenset(self.table))

    async def health(self) -> Health:
        return Health(True)

    async def read(self, request: ReadRequest) -> list[Read]:
        self.requests.append(request)
        return [self._answer(request, name, vote) for name in request.components for vote in request.votes][::-1]

    def _answer(self, request: ReadRequest, name: Component, vote: Vote) -> Read:
        entry = self.table[name]
        levels = entry if isinstance(entry[0], float) else entry[min(vote.index, len(entry) - 1)]
        if request.stage is Stage.REFLECT:
            levels = self.second.get(name, levels)
        order = option_order(vote, request.clip.sha256, name, len(levels))
        return Read(
            name, map_back([levels[level] for level in order], order), vote.kind, vote,
            label_mass=self.label_mass.get(name, 1.0) if vote.kind == "label" else 1.0,
            evidence_text=f"{name} looks so", frames_cited=self.cited, focus=self.focus,
            cost=Cost(calls=1, prompt_tokens=10),
        )

    def asked(self, stage: Stage) -> list[tuple[tuple[Component, ...], int]]:
        """Components and vote index of every request of a stage."""
        return [(r.components, r.votes[0].index) for r in self.requests if r.stage is stage]


class FaultyJudge(ScriptedJudge):
    """Goes wrong whenever it is asked about `component`, in the way named by `fault`."""

    def __init__(self, table: Mapping[str, Levels | Sequence[Levels]], component: Component, fault: str) -> None:
        super().__init__(table)
        self.component, self.fault = component, fault

    async def read(self, request: ReadRequest) -> list[Read]:
        reads = await super().read(request)
        if self.component not in request.components:
            return reads
        if self.fault == "unavailable":
            raise JudgeError("circuit open", Cost(calls=4, retries=3))
        if self.fault == "crash":
            raise ZeroDivisionError("division by zero")
        return [bent for read in reads for bent in (self._bend(read) if read.component == self.component else [read])]

    def _bend(self, read: Read) -> list[Read]:
        changed = {
            "error": {"status": Status.ERROR, "levels": (), "reason": "finish_reason length"},
            "abstain": {"status": Status.ABSTAIN, "levels": (), "reason": "out of distribution"},
            "nan": {"levels": (float("nan"),) * len(read.levels)},
            "sum": {"levels": (0.5,) * len(read.levels)},
            "short": {"levels": (1.0,)},
            "mass": {"label_mass": 0.3},
        }
        if self.fault == "missing":
            return []
        if self.fault == "twice":
            return [read, read]
        return [Read(**{**vars(read), **changed[self.fault]})]
