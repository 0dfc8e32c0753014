"""What people say of clips: the file that the viewer exports, for `agree` and `people`."""

from codecs import BOM_UTF8
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import NUM_LEVELS, NUM_PLAN_LEVELS, PLANNING
from wm_nodes.judge.audit.log import AuditError
from wm_nodes.judge.audit.reading import RecordedEvaluation
from wm_nodes.judge.decisions import OVERALL, stage_labels

FORMAT = "audit-labels-1"
HACK = "hack: "
"""In front of a pattern's name, because a pattern may be called like a component. It passes where it is absent."""

Answer = bool | int | None
"""True: passes. False: fails. Of planning: the level. None: unsure."""


class _FrozenModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RowLabel(_FrozenModel):
    """What one person said of one row."""

    answer: Literal["pass", "fail", "unsure"]
    """Of the row."""
    level: Annotated[int, Field(ge=0, lt=NUM_LEVELS)] | None = None
    """Where the person gave one, from 0."""
    explanation: bool | None = None
    """Whether the judge's reason is right; None: not said."""


class ClipLabel(_FrozenModel):
    """What one person said of one clip."""

    evaluation: int
    """Line of the log."""
    sha256: str
    """Of the clip."""
    audit_id: str
    """Of the verdict."""
    rows: dict[str, RowLabel]
    """By component, "planning", "overall" or "hack: PATTERN"."""


class HumanLabels(_FrozenModel):
    """What one person said of the clips of one page."""

    format: Literal["audit-labels-1"]
    """Name and version of the file's format."""
    head: str
    """Hash of the log's last line when the page was written."""
    annotator: Annotated[str, Field(min_length=1)]
    """Name of the person."""
    exported: str
    """Time of the export, ISO 8601, UTC."""
    labels: tuple[ClipLabel, ...]
    """One per clip that has any."""


def read_labels(path: Path) -> HumanLabels:
    """Read an exported file. Raises AuditError: it cannot be read or is no such file; OSError: it is not there."""
    try:
        return HumanLabels.model_validate_json(Path(path).read_bytes().removeprefix(BOM_UTF8))
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        where = ".".join(map(str, first["loc"])) or "file"
        raise AuditError(f"{path} is no exported file of labels: {where}: {first['msg']}; export it again") from None


def known_answers(label: ClipLabel, rubric: Rubric) -> dict[str, Answer]:
    """What one person decided, by row of the table; of stages, see stage_labels. None: unsure.

    Raises:
        AuditError: a row that the rubric does not have, or a planning label without a level 0 to 3.
    """
    rows = {PLANNING, OVERALL, *rubric.component_names, *(HACK + name for name in rubric.hack.patterns)}
    if foreign := sorted(set(label.rows) - rows):
        raise AuditError(f"evaluation {label.evaluation}: rubric {rubric.version} has no row {', '.join(foreign)}")
    known: dict[str, Answer] = {}
    for name, row in label.rows.items():
        known[name] = None if row.answer == "unsure" else row.answer == "pass"
        if name == PLANNING and row.answer != "unsure":
            if row.level is None or row.level >= NUM_PLAN_LEVELS:
                raise AuditError(f"evaluation {label.evaluation}: planning needs a level 0 to 3, got {row.level}")
            known[name] = row.level
    return {**known, **stage_labels(known, rubric)}


def find_evaluation(
    number: int, audit_id: str, evaluations: Mapping[int, RecordedEvaluation], source: str
) -> RecordedEvaluation:
    """The evaluation that a label or a sample means. Raises AuditError: the log holds none or another one there."""
    evaluation = evaluations.get(number)
    if evaluation is None or evaluation.outcome is None or evaluation.outcome.audit_id != audit_id:
        raise AuditError(f"{source}: evaluation {number} is another one in this log; name the log it is from")
    return evaluation


def annotators(files: Sequence[HumanLabels]) -> list[str]:
    """The names, once each, in order. Raises AuditError: one person labelled one evaluation in two files."""
    seen: set[tuple[str, str, int]] = set()
    for file in files:
        for label in file.labels:
            key = (file.annotator, label.audit_id, label.evaluation)
            if key in seen:
                raise AuditError(f"{file.annotator} labelled evaluation {label.evaluation} twice; give the newest file")
            seen.add(key)
    return list(dict.fromkeys(file.annotator for file in files))
