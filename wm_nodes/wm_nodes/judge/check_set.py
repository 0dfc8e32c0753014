"""The shipped set of labelled clips that any judge is checked on: pretrained/judge_check.

clips.jsonl and its pictures are read as clip_files reads a user's; labels.jsonl has a line per clip in the same order
(RA-21); manifest.json says where they come from and names the SHA-256 of every file. Two parts: near cameras of three
tasks, 96 x 96 px, and the whole picture of the policy's cameras side by side, 64 x 128 px.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wm_nodes.config.shipped import PRETRAINED
from wm_nodes.core.files import text_lines
from wm_nodes.core.named_files import CLIP_LIST, FileKind, read_regular
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING, Stage
from wm_nodes.judge.clip_files import read_job, read_list
from wm_nodes.judge.decisions import OVERALL, stage_labels
from wm_nodes.judge.service import ClipJob

CHECK_SET = PRETRAINED / "judge_check"
FORMAT = "judge-check-1"
LABELS, MANIFEST = "labels.jsonl", "manifest.json"
CLEAN, BENIGN = "clean", "benign"
"""Families without a fault."""
PASSES_FROM = 3
"""Level of task completion from which it passes: "nearly" (RA-5)."""


class ClipTruth(BaseModel):
    """What is known of one clip, a line of labels.jsonl."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    clip_id: str
    """As in clips.jsonl."""
    part: Literal["near", "policy"]
    """Near cameras, or the policy's picture."""
    kind: str
    """"clean", "benign", or the name of the fault."""
    family: str
    """"clean", "benign", or what the fault was made in: "pixels", "time", "state"."""
    parent: str
    """clip_id of the recording that it was made of; its own where it is one."""
    edits: tuple[str, ...]
    """What was done to the recording: name, severity, amount, unit."""
    origin: Mapping[str, str | int]
    """Of the recording: reset seed, scripted behaviour, camera, object, scene."""
    components: Mapping[str, bool | None]
    """Whether each passes; None where nobody can tell."""
    planning: Annotated[int, Field(ge=0, le=3)] | None
    """Planning level; None where nobody can tell."""
    completion: Annotated[int, Field(ge=0, le=4)]
    """How far the task gets: 0 not begun, 4 done."""
    patterns: tuple[str, ...]
    """Hacking patterns that are present."""
    success: bool
    """The task is done and nothing fails: a reward should pay this clip."""

    @property
    def is_fault(self) -> bool:
        return self.family not in (CLEAN, BENIGN)

    def rows(self, rubric: Rubric) -> dict[str, bool | int | None]:
        """The right decision of every row of Table 2 (decisions.py); None where nobody can tell."""
        known: dict[str, bool | int | None] = {name: self.components.get(name) for name in rubric.component_names}
        if Stage.TC in rubric.stages:
            known |= dict.fromkeys(rubric.stages[Stage.TC].components, self.completion >= PASSES_FROM)
        return {**known, **stage_labels(known, rubric), PLANNING: self.planning, OVERALL: self.success}


@dataclass(frozen=True, eq=False)
class LabelledClip:
    """A clip to judge and what is known of it."""

    job: ClipJob
    truth: ClipTruth


def load_check_set(folder: Path = CHECK_SET) -> list[LabelledClip]:
    """Read every clip with its label.

    Raises:
        ValueError: a file is missing, is not the one of the manifest, or does not fit the others.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_bytes())
        if manifest.get("format") != FORMAT:
            raise ValueError(f"its format is {manifest.get('format')!r}, not {FORMAT!r}")
        read = partial(_read_verified, folder=folder, hashes=manifest["sha256"])
        lines = read_list(folder, read)
        truths = [ClipTruth.model_validate_json(text) for text in text_lines(read(folder / LABELS, CLIP_LIST))]
        if [line.clip_id for line in lines] != [truth.clip_id for truth in truths]:
            raise ValueError(f"{LABELS} and clips.jsonl name different clips")
        jobs = [read_job(folder, line, read) for line in lines]
        if problem := next((job.problem for job in jobs if job.problem), ""):
            raise ValueError(problem)
    except (OSError, KeyError, AttributeError, ValidationError, ValueError) as error:
        raise ValueError(f"the check set in {folder} cannot be used: {error}; install wm_nodes again") from None
    return [LabelledClip(job, truth) for job, truth in zip(jobs, truths, strict=True)]


def _read_verified(path: Path, kind: FileKind, *, folder: Path, hashes: Mapping[str, Any]) -> bytes:
    """The bytes of a file of the set. Raises ValueError: not those of the manifest. OSError: it cannot be read."""
    name, data = str(path.relative_to(folder)), read_regular(path, kind)
    if hashlib.sha256(data).hexdigest() != hashes.get(name):
        raise ValueError(f"{name} is not the file that {MANIFEST} names (sha256)")
    return data
