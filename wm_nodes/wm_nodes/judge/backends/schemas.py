"""What a judge's JSON answer must look like, and whether it makes sense.

One schema per call type: nothing beside the named properties, every string and list bounded, evidence before level, so
that the model looks before it scores.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model

from wm_nodes.judge.agent.types import NUM_LEVELS, NUM_PLAN_LEVELS, PLANNING, Component, Stage

NO_PROBLEM = "none"
_DECODER = json.JSONDecoder()
COMPLETED_FROM = 3
"""Progress level from which a task counts as completed."""



def _whole(value: Any) -> Any:
    """3 of 3.0, which means the same; anything else as it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Text = Annotated[str, Field(min_length=1, max_length=240)]
Frame = Annotated[int, Field(ge=0), BeforeValidator(_whole)]
Frames = Annotated[list[Frame], Field(max_length=4)]
CitedFrames = Annotated[list[Frame], Field(min_length=1, max_length=4)]
Level = Annotated[int, Field(ge=0, le=NUM_LEVELS - 1), BeforeValidator(_whole)]
PlanLevel = Annotated[int, Field(ge=0, le=NUM_PLAN_LEVELS - 1), BeforeValidator(_whole)]


class AnswerError(ValueError):
    """The answer does not pass; the text says why, for the log and for the model that may try again."""


@dataclass(frozen=True)
class ComponentAnswer:
    """What an answer says of one component, whatever its call type."""

    component: Component
    """Its name."""
    level: int
    """Of PLANNING 0..3, else 0..4."""
    evidence: str = ""
    """In words."""
    frames: tuple[int, ...] = ()
    """Cited ones."""
    focus: tuple[Component, ...] = ()
    """Of PLANNING, components with a visible problem."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _Component(_Strict):
    evidence: Text
    frames: Frames
    level: Level


class _Task(_Strict):
    required_end_state: Text
    observed_end_state: Text
    frames: Frames
    progress: Level
    completed: bool


class AnswerFormat:
    """One call type: its schema, and the reading of an answer.

    Args:
        shown: clip frame indices that the model sees; it may cite no others.
        problems: for planning, the components that it may name as visibly bad; the rubric's own names, so that a new
            domain brings its words along.
        prior: for reflection, the level each component had.
    """

    def __init__(
        self, stage: Stage, components: Sequence[Component], shown: Iterable[int], *,
        problems: Sequence[Component] = (), prior: Mapping[Component, int] | None = None,
    ) -> None:
        self._components = tuple(components)
        self._shown = frozenset(shown)
        self._problems = tuple(problems)
        self._prior = prior or {}
        if stage is Stage.REFLECT and (unknown := sorted(set(components) - set(self._prior))):
            raise ValueError(f"reflection needs the earlier level of each component; {', '.join(unknown)} have none")
        self.name, self.model = self._make_model(stage)

    @property
    def response_format(self) -> dict[str, Any]:
        """The structured-output request of the chat-completions protocol."""
        schema = self.model.model_json_schema()
        return {"type": "json_schema", "json_schema": {"name": self.name, "strict": True, "schema": schema}}

    def read(self, text: str) -> list[ComponentAnswer]:
        """Parse an answer and check schema and sense; one finding per component. Raises AnswerError: what is wrong."""
        try:
            answer: Any = self.model.model_validate_json(json_object(text))
        except ValidationError as error:
            raise AnswerError("; ".join(_describe_problem(problem) for problem in error.errors()[:3])) from None
        if self.name == "plan":
            return [self._read_plan(answer)]
        if self.name == "reflect":
            return self._read_reflection(answer)
        if self.name == "hack":
            self._check_once([item.pattern for item in answer.items])
            worst, best = 0, NUM_LEVELS - 1
            return [
                ComponentAnswer(item.pattern, worst if item.present else best, item.evidence) for item in answer.items
            ]
        if self.name == "task":
            return [self._read_task(answer)]
        items = [answer] if self.name == "component" else answer.items
        names = self._components if self.name == "component" else [item.component for item in items]
        self._check_once(names)
        return [
            ComponentAnswer(name, item.level, item.evidence, self._check_cited(item.frames))
            for name, item in zip(names, items, strict=True)
        ]

    def _make_model(self, stage: Stage) -> tuple[str, type[BaseModel]]:
        names: Any = Literal[self._components]  # type: ignore[valid-type]
        count = len(self._components)
        if stage is Stage.PLAN:
            words: Any = Literal[(*self._problems, NO_PROBLEM)]  # type: ignore[valid-type]
            problems = Annotated[list[words], Field(max_length=4)]  # type: ignore[valid-type]
            return "plan", _model("Plan", summary=Text, visible_problems=problems, level=PlanLevel)
        if stage is Stage.REFLECT:
            change = _model(
                "Change", component=names, old_level=Level, new_level=Level, reason=Text, frames=CitedFrames
            )
            changes = Annotated[list[change], Field(max_length=4)]  # type: ignore[valid-type]
            return "reflect", _model("Reflect", changes=changes, consistent=bool)
        if stage is Stage.HACK:
            pattern = _model("Pattern", pattern=names, evidence=Text, present=bool)
            return "hack", _model("Hack", items=_list_of(pattern, count))
        if count == 1:
            return ("task", _Task) if stage is Stage.TC else ("component", _Component)
        item = _model("Item", component=names, evidence=Text, frames=Frames, level=Level)
        return "stage_pack", _model("StagePack", items=_list_of(item, count))

    def _read_plan(self, answer: Any) -> ComponentAnswer:
        named = [word for word in answer.visible_problems if word != NO_PROBLEM]
        if NO_PROBLEM in answer.visible_problems and named:
            raise AnswerError(f"visible_problems says {NO_PROBLEM!r} beside {named}")
        return ComponentAnswer(PLANNING, answer.level, answer.summary, focus=tuple(dict.fromkeys(named)))

    def _read_task(self, answer: Any) -> ComponentAnswer:
        if answer.completed != (answer.progress >= COMPLETED_FROM):
            raise AnswerError(
                f"completed is {answer.completed} at progress {answer.progress}; "
                f"completed means progress {COMPLETED_FROM} or more"
            )
        evidence = f"required: {answer.required_end_state}; observed: {answer.observed_end_state}"
        return ComponentAnswer(self._components[0], answer.progress, evidence, self._check_cited(answer.frames))

    def _read_reflection(self, answer: Any) -> list[ComponentAnswer]:
        """Every component with its new level; those that are not changed keep theirs."""
        answers = {name: ComponentAnswer(name, self._prior[name]) for name in self._components}
        changed = [change.component for change in answer.changes]
        twice = sorted(name for name, times in Counter(changed).items() if times > 1)
        if twice:
            raise AnswerError(f"changes names {', '.join(twice)} more than once")
        for change in answer.changes:
            if change.old_level != self._prior[change.component]:
                raise AnswerError(f"old_level of {change.component} was {self._prior[change.component]}")
            if change.new_level == change.old_level:
                raise AnswerError(f"new_level of {change.component} equals its old_level; leave it out instead")
            frames = self._check_cited(change.frames)
            answers[change.component] = ComponentAnswer(change.component, change.new_level, change.reason, frames)
        return list(answers.values())

    def _check_once(self, names: Sequence[Component]) -> None:
        if sorted(names) != sorted(self._components):
            raise AnswerError(f"items must name each of {', '.join(self._components)} once, got {', '.join(names)}")

    def _check_cited(self, frames: Sequence[int]) -> tuple[int, ...]:
        unknown = sorted(set(frames) - self._shown)
        if unknown:
            raise AnswerError(f"frames {unknown} were not shown; cite some of {sorted(self._shown)}")
        return tuple(frames)


def strip_reasoning(text: str) -> str:
    """What follows the model's reasoning. Raises AnswerError: the reasoning never ended."""
    _, end, rest = text.rpartition("</think>")
    if not end and "<think>" in text:
        raise AnswerError("the answer ends inside <think>")
    return rest.strip()


def json_object(text: str) -> str:
    """The one JSON object of an answer; reasoning, words and a fence around it are left out.

    Raises:
        AnswerError: there is none, a brace that begins no whole object, or more than one.
    """
    rest, found = strip_reasoning(text), ""
    start = rest.find("{")
    while start >= 0:
        try:
            _, end = _DECODER.raw_decode(rest, start)
        except (ValueError, RecursionError) as error:
            raise AnswerError(f"Invalid JSON: {error}") from None
        if found:
            raise AnswerError("the answer holds more than one JSON object")
        found, start = rest[start:end], rest.find("{", end)
    if not found:
        raise AnswerError("Invalid JSON: the answer holds no object")
    return found


def _model(name: str, **properties: Any) -> type[BaseModel]:
    fields: dict[str, Any] = {key: (kind, ...) for key, kind in properties.items()}
    return create_model(name, __base__=_Strict, **fields)


def _list_of(item: type[BaseModel], count: int) -> Any:
    return Annotated[list[item], Field(min_length=count, max_length=count)]  # type: ignore[valid-type]


def _describe_problem(problem: Any) -> str:
    """One validation problem in words; pydantic's text for unreadable JSON carries the place."""
    where = ".".join(map(str, problem["loc"]))
    return f"{where}: {problem['msg']}" if where else problem["msg"]
