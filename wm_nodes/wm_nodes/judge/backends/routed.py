"""A judge that routes each stage to one of several judges."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace

from wm_nodes.judge.agent.judge import Capabilities, Health, Judge, JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING, Component, Stage

TRANSPORT = "routed"
OPEN_BREAKERS = "open_breakers"
"""The detail that diagnostics show; see OpenAIJudge.health."""


class RoutedJudge:
    """Has some stages read by other judges, everything else by `first`. Second looks (REFLECT) go to whoever reads the
    component's own stage.

    Its identity covers all of them with their stages: with other routes it is another judge. Its max_frames is the
    smallest of theirs.

    Raises:
        ValueError: a stage routed twice, a route of REFLECT, or a judge that does not read a component of its stages.
    """

    def __init__(self, first: Judge, routes: Sequence[tuple[Sequence[Stage], Judge]], rubric: Rubric) -> None:
        self._rubric = rubric
        routed_names = ("+".join(stage for stage in Stage if stage in stages) for stages, _ in routes)
        self._judges = [("", first), *zip(routed_names, (judge for _, judge in routes))]
        routed = [(stage, to) for stages, to in routes for stage in stages]
        self._routes = dict(routed)
        if Stage.REFLECT in self._routes or len(self._routes) < len(routed):
            named = ", ".join(stage for stage, _ in routed)
            raise ValueError(f"each stage has one route and {Stage.REFLECT} follows its components; got {named}")
        needed: dict[Stage, set[Component]] = {Stage.PLAN: {PLANNING}}
        needed |= {stage: set(rubric.stages[stage].components) for stage in rubric.gated}
        needed[Stage.HACK] = set(rubric.hack.patterns if rubric.hack.enabled else ())
        for stage, names in needed.items():
            able = self._judge_of(stage).capabilities
            if able.components is not None and (blind := sorted(names - able.components)):
                raise ValueError(f"{able.judge_id} does not read {', '.join(blind)}; route {stage} to another judge")
        self._components = frozenset[Component]().union(*needed.values())

    @property
    def capabilities(self) -> Capabilities:
        able = [(stages or "else", judge.capabilities) for stages, judge in self._judges]
        who = "; ".join(f"{stages}: {part.judge_id}" for stages, part in able)
        return Capabilities(
            f"{TRANSPORT}:{hashlib.sha256(who.encode()).hexdigest()[:12]}", TRANSPORT, who,
            "; ".join(part.server_version for _, part in able if part.server_version), self._components,
            max_frames=min(part.max_frames for _, part in able),
            card="\n".join(f"{stages}: {part.card or part.judge_id}" for stages, part in able),
        )

    async def read(self, request: ReadRequest) -> list[Read]:
        """As Judge.read; a second look may ask several judges in turn. Raises JudgeError: one could not answer."""
        if request.stage is not Stage.REFLECT:
            return await self._judge_of(request.stage).read(request)
        parts: dict[int, tuple[Judge, list[Component]]] = {}
        for name in request.components:
            judge = self._judge_of(self._rubric.stage_of(name))
            parts.setdefault(id(judge), (judge, []))[1].append(name)
        reads: list[Read] = []
        for judge, names in parts.values():
            try:
                reads += await judge.read(replace(request, components=tuple(names)))
            except JudgeError as error:
                raise JudgeError(str(error), sum((read.cost for read in reads), error.cost)) from error
        return reads

    async def health(self) -> Health:
        """Available where all are. Details of routed ones carry their stages; open breakers are counted together."""
        states = [(stages, await judge.health()) for stages, judge in self._judges]
        details = {
            f"{stages} {name}".strip(): value for stages, state in states for name, value in state.details.items()
        }
        open_breakers = sum(state.details.get(OPEN_BREAKERS, 0.0) for _, state in states)
        return Health(
            all(state.available for _, state in states),
            "; ".join(f"{stages} {state.reason}".strip() for stages, state in states if state.reason),
            {**details, OPEN_BREAKERS: open_breakers},
        )

    def _judge_of(self, stage: Stage) -> Judge:
        return self._routes.get(stage, self._judges[0][1])
