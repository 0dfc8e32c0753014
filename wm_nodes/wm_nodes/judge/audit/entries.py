"""What the lines of an audit log hold, as JSON and back.

rubric {version, rubric}; agent {capabilities, rubric_version, settings}; clip {sha256, fps, source, frames}: once each.
evaluation {clip_id, sha256, agent, round, task, evidence}: its line number is its name in what follows:
ask {evaluation, stage, components, profile, votes, media, mode}; read {evaluation, ask, read}, one line each;
exchange {evaluation, prompt_sha, ...}: what went over the wire; failure {evaluation, ask, error, reason, cost};
verdict {evaluation, verdict}; round {round}; recovered {...}.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from wm_nodes.judge.agent.judge import Capabilities, Cost, MediaItem, Read, Vote
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import ClipRef, TaskSpec
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.log import AuditError
from wm_nodes.judge.audit.media import MediaStore

_ADAPTERS: dict[type, TypeAdapter[Any]] = {
    kind: TypeAdapter(kind) for kind in (Capabilities, Cost, MediaItem, Read, Verdict, Vote)
}


def plain(value: Any) -> Any:
    """JSON values of dataclasses, mappings, sequences, numbers; NaN and infinities as the texts that `typed` reads."""
    if value is None or type(value) in (str, int, bool):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted(plain(item) for item in value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def typed(kind: type, value: Any) -> Any:
    """The dataclass that `plain` made these JSON values of. Raises AuditError: they do not fit (other version)."""
    try:
        return _ADAPTERS[kind].validate_python(value)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        problem = f"this is no {kind.__name__}: {where}: {first['msg']}"
        raise AuditError(f"{problem}; was it written by another version?") from None


def rubric_body(rubric: Rubric) -> dict[str, Any]:
    """A rubric line: the resolved pack as a text, because the order of its components counts."""
    return {"version": rubric.version, "rubric": json.dumps(plain(rubric.model_dump(mode="json")))}


def rubric_from(value: Mapping[str, Any]) -> Rubric:
    """The rubric of a rubric line. Raises AuditError: it is another one, or of another version of the program."""
    try:
        rubric = Rubric.model_validate(json.loads(value["rubric"]))
    except ValidationError as error:
        raise AuditError(f"rubric {value['version']} cannot be read by this version: {error}") from None
    if rubric.version != value["version"]:
        raise AuditError(f"rubric {value['version']} is {rubric.version} to this version of the program")
    return rubric


def clip_body(clip: ClipRef, store: MediaStore) -> dict[str, Any]:
    """A clip line; stores the frames, one file each where they are pictures, else as one array."""
    frames = np.asarray(clip.frames)
    pictures = frames.dtype == np.uint8 and frames.ndim == 4 and frames.shape[3] == 3 and frames.size > 0
    stored = [store.put(frame) for frame in frames] if pictures else store.put(frames)
    return {"sha256": clip.sha256, "fps": plain(clip.fps), "source": clip.source, "frames": stored}


def clip_from(body: Mapping[str, Any], clip_id: str, store: MediaStore) -> ClipRef:
    """The clip of a clip line, pixels included. Raises AuditError: a picture is missing or was changed."""
    names = body["frames"]
    frames = store.get(names) if isinstance(names, str) else np.stack([store.get(name) for name in names])
    return ClipRef(clip_id, body["sha256"], frames, float(body["fps"]), body["source"])


def task_body(task: TaskSpec, store: MediaStore) -> dict[str, Any]:
    images = {"reference_frame": task.reference_frame, "goal_image": task.goal_image, "actions": task.actions}
    stored = {name: None if image is None else store.put(np.asarray(image)) for name, image in images.items()}
    words = {name: getattr(task, name) for name in ("instruction", "task_id", "robot")}
    return {**words, **stored}


def task_from(body: Mapping[str, Any], store: MediaStore) -> TaskSpec:
    arrays = {
        name: None if body[name] is None else store.get(body[name])
        for name in ("reference_frame", "goal_image", "actions")
    }
    return TaskSpec(**{**body, **arrays})
