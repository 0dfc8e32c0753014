"""Rubric packs: components, level descriptions, weights and thresholds as versioned data (RA-4 to RA-14).

A pack is a YAML file in rubrics/, or anywhere. `extends` lays it over another pack: mappings are merged name by name,
so a new domain adds components or patterns without code, and `null` takes what it names away. Its version
names the resolved content.
"""

import hashlib
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from wm_nodes.config.load import ConfigError, parse_yaml, read_yaml, refusal
from wm_nodes.core.named_files import shown
from wm_nodes.judge.agent.types import GATED, NUM_LEVELS, NUM_PLAN_LEVELS, Component, Profile, Stage

Share = Annotated[float, Field(ge=0, le=1)]
FiveLevels = Annotated[tuple[str, ...], Field(min_length=NUM_LEVELS, max_length=NUM_LEVELS)]
Row = Annotated[tuple[Share, ...], Field(min_length=len(GATED), max_length=len(GATED))]
Text = Annotated[str, Field(min_length=1)]


class RubricSection(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ComponentRubric(RubricSection):
    question: Text
    """What the positive question asks."""
    defect: Text
    """What the negative question asks: which defect is visible."""
    levels: FiveLevels
    """What levels 0 to 4 look like, worst first."""
    weight: Annotated[float, Field(gt=0)] = 1.0
    """In the weighted mean of its stage."""


class StageRubric(RubricSection):
    threshold: Share
    """theta: a lower stage score is a failed gate."""
    profile: Profile
    """Which frames a read sees."""
    components: Annotated[dict[Component, ComponentRubric], Field(min_length=1)]
    """By name, in the order of the table."""


class PlanningRubric(RubricSection):
    question: Text
    """What is asked of the clip as a whole."""
    levels: Annotated[tuple[str, ...], Field(min_length=NUM_PLAN_LEVELS, max_length=NUM_PLAN_LEVELS)]
    """What L0 invalid to L3 good look like."""
    weights: Annotated[tuple[Row, ...], Field(min_length=NUM_PLAN_LEVELS, max_length=NUM_PLAN_LEVELS)]
    """Rows L0 to L3, columns VQ, IF, TC, PC; each row sums to 1."""
    ceiling: Annotated[tuple[Share, ...], Field(min_length=NUM_PLAN_LEVELS, max_length=NUM_PLAN_LEVELS)]
    """The largest reward of a clip of each planning level."""
    num_focus: Annotated[int, Field(ge=0)]
    """Components that planning may ask to be voted first."""

    @model_validator(mode="after")
    def _check_weights(self) -> "PlanningRubric":
        for level, row in enumerate(self.weights):
            if abs(sum(row) - 1) > 1e-9:
                raise ValueError(f"weights of L{level} sum to {sum(row)}, not 1")
        return self


class VotingRubric(RubricSection):
    k: Annotated[int, Field(ge=1)]
    """Votes of a component that is voted on; two equal ones of three end it early."""
    k_max: Annotated[int, Field(ge=1)]
    """More votes than this: ABSTAIN."""
    clear_margin: Share
    """A component whose first read has a smaller margin is voted on."""
    levels: tuple[int, ...]
    """Planning levels at which every component is voted on."""
    audit_share: Share
    """Share of clips, drawn by content, that are audited: every component is voted on, and hacking patterns are read
    behind a closed gate, too."""
    min_label_mass: Share
    """A read with less: ABSTAIN."""
    veto: Share
    """A component with at least this p_fail fails its stage."""

    @model_validator(mode="after")
    def _check_votes(self) -> "VotingRubric":
        if self.k % 2 == 0 or self.k_max < self.k:
            raise ValueError(f"k must be odd and at most k_max, got k {self.k}, k_max {self.k_max}")
        return self


class Cap(RubricSection):
    """What a confirmed pattern does: it limits a component, or fails a whole stage with s = 0."""

    component: Component | None = None
    """Whose s is limited."""
    ceiling: Share = 0.0
    """The most that its s may be."""
    stage: Stage | None = None
    """That fails instead."""

    @model_validator(mode="after")
    def _check_target(self) -> "Cap":
        if (self.component is None) == (self.stage is None) or (self.stage is not None and self.stage not in GATED):
            raise ValueError("a cap needs either a component or one of the stages VQ, IF, TC, PC")
        return self


class PatternRubric(ComponentRubric):
    """A hacking pattern, read like a component: level 0 surely there, 4 surely not."""

    cap: Cap


class HackRubric(RubricSection):
    enabled: bool
    """Read the patterns of clips whose stages were all read: no early exit; and of audited clips."""
    confirm: Share
    """A pattern this probable in two reads is confirmed."""
    patterns: dict[str, PatternRubric]
    """By name."""


class Conflict(RubricSection):
    """Logically impossible: `done` passes while one of `needs` fails."""

    done: Component
    needs: tuple[Component, ...]


class ReflectionRubric(RubricSection):
    enabled: bool
    """Look again at all."""
    margin: Share
    """A component that decided a gate with a smaller margin is looked at again."""
    level_gap: Annotated[float, Field(gt=0)]
    """Planning level against 3 x mean stage score: a difference of this much is looked at again."""
    max_changes: Annotated[int, Field(ge=1)]
    """Components of one second look."""
    audit_share: Share
    """Share of clips, drawn by content, that are looked at again without another reason."""
    conflicts: tuple[Conflict, ...]
    """Pairs that contradict each other."""


class RewardRubric(RubricSection):
    gate: Literal["hard", "open"]
    """hard: prod 1[S >= theta]. open: none closes."""
    mean_share: Share
    """Stage score = mean_share x weighted mean + (1 - mean_share) x minimum."""


class Rubric(RubricSection):
    name: Text
    """Of the pack."""
    revision: Annotated[int, Field(ge=1)]
    """Raised by its author with every change of words."""
    planning: PlanningRubric
    """The first read."""
    stages: dict[Stage, StageRubric]
    """Those that are scored and gated."""
    voting: VotingRubric
    """When components are asked again."""
    hack: HackRubric
    """The hacking patterns."""
    reflection: ReflectionRubric
    """The second look."""
    reward: RewardRubric
    """How scores become a number."""

    @model_validator(mode="after")
    def _check_names(self) -> "Rubric":
        if not self.gated or len(self.gated) < len(self.stages):
            raise ValueError(f"stages must be among VQ, IF, TC, PC, got {', '.join(self.stages)}")
        for column, stage in enumerate(GATED):
            if stage not in self.stages and any(row[column] for row in self.planning.weights):
                raise ValueError(f"planning.weights pay {stage}, which is none of the stages; set its column to 0")
        if hanging := [n for n, p in self.hack.patterns.items() if p.cap.stage and p.cap.stage not in self.stages]:
            raise ValueError(f"hack.patterns {', '.join(hanging)} cap a stage that is not there; set them to null")
        known = self.component_names
        if len(set(known)) != len(known):
            raise ValueError(f"a component is in two stages: {', '.join(known)}")
        used = {name for rule in self.reflection.conflicts for name in (rule.done, *rule.needs)}
        used |= {pattern.cap.component for pattern in self.hack.patterns.values() if pattern.cap.component}
        if unknown := sorted(used - set(known)):
            raise ValueError(f"unknown components {', '.join(unknown)}; known: {', '.join(known)}")
        return self

    @property
    def gated(self) -> tuple[Stage, ...]:
        """The stages that are read, in the order of GATED; the reward agent skips the others."""
        return tuple(stage for stage in GATED if stage in self.stages)

    @property
    def component_names(self) -> tuple[Component, ...]:
        """Of the gated stages, in the order of the pack."""
        return tuple(name for stage in self.gated for name in self.stages[stage].components)

    @property
    def version(self) -> str:
        """name-revision-hash: differs whenever a word or number of the resolved pack does."""
        digest = hashlib.sha256(self.model_dump_json().encode()).hexdigest()
        return f"{self.name}-{self.revision}-{digest[:12]}"

    def stage_of(self, component: Component) -> Stage:
        return next(stage for stage in self.gated if component in self.stages[stage].components)


def load_rubric(
    pack: str = "robot", overrides: Mapping[str, Any] | None = None, read: Callable[[str], bytes] | None = None
) -> Rubric:
    """Read a pack of rubrics/, or a YAML file, with what it extends.

    Args:
        overrides: nested mapping laid on top, e.g. {"reward": {"gate": "open"}}.
        read: reads the YAML files; None: from anywhere.

    Raises:
        ConfigError: no such pack, or values refused; names each of them. What `read` raises, but FileNotFoundError.
    """
    try:
        return Rubric.model_validate(_merge(_resolve(pack, (), read), overrides or {}))
    except ValidationError as error:
        raise refusal(error, f"wm_nodes/judge/agent/rubric.py, pack {pack}") from None


def pack_names() -> list[str]:
    return sorted(Path(entry.name).stem for entry in _pack_folder().iterdir() if entry.name.endswith(".yaml"))


def _pack_folder() -> Any:
    return resources.files("wm_nodes.judge.agent") / "rubrics"


def _resolve(pack: str, seen: tuple[str, ...], read: Callable[[str], bytes] | None) -> dict[str, Any]:
    if pack in seen:
        raise ConfigError(f"rubric packs extend each other in a circle: {' -> '.join((*seen, pack))}")
    try:
        if pack in pack_names():
            values = read_yaml(_pack_folder() / f"{pack}.yaml")
        elif Path(pack).suffix not in {".yaml", ".yml"} or (read is None and not Path(pack).exists()):
            raise FileNotFoundError
        else:
            values = read_yaml(Path(pack)) if read is None else parse_yaml(read(pack), pack)
    except FileNotFoundError:
        raise ConfigError(
            f"unknown rubric pack {shown(pack)}; choose one of {', '.join(pack_names())} or give a .yaml file"
        ) from None
    base = values.pop("extends", None)
    return values if base is None else _merge(_resolve(str(base), (*seen, pack), read), values)


def _merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for name, value in top.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(name), Mapping)
        merged[name] = _merge(merged[name], value) if both else value
    return {name: value for name, value in merged.items() if value is not None}
