"""An audit log as a whole: evaluations with their reads and verdicts, in the order of their lines; and `verify`."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wm_nodes.judge.agent.judge import Capabilities, MediaItem, Read, Vote
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import ClipRef, TaskSpec, media_sha
from wm_nodes.judge.agent.verdict import Verdict, content_hash
from wm_nodes.judge.audit.entries import clip_from, rubric_from, task_from, typed
from wm_nodes.judge.audit.log import NO_LINE, AuditError, Entry, faults, read_lines
from wm_nodes.judge.audit.media import MediaStore

Subject = tuple[str | None, ...]
"""See subject_of."""


@dataclass(frozen=True)
class Failure:
    """Why a question has no answer."""

    error: str
    """The exception's name; "CancelledError" where the clip ran out of time."""
    reason: str
    """In words."""
    cost: Mapping[str, Any] | None
    """Of the attempts; None where unknown."""


@dataclass
class Ask:
    """One question to the judge with its answers."""

    stage: str
    """What it was for."""
    components: tuple[str, ...]
    """Asked about."""
    votes: tuple[Vote, ...]
    """How."""
    media: tuple[MediaItem, ...]
    """Shown images."""
    reads: list[Read] = field(default_factory=list)
    """The answers."""
    failure: Failure | None = None
    """None where there are answers."""


@dataclass(frozen=True)
class AgentLine:
    """Who judged."""

    number: int
    """Of the line."""
    capabilities: Capabilities
    """What the judge can do."""
    rubric_version: str
    """Of the words of the questions."""
    settings: Mapping[str, Any]
    """RewardAgent's."""


@dataclass
class RecordedEvaluation:
    """One clip being judged once."""

    number: int
    """Of its line, its name."""
    clip_id: str
    """Of the clip."""
    sha256: str
    """Of its content."""
    round_number: int
    """Of the training, or of clips of your own."""
    agent: AgentLine
    """Who judged."""
    task: Mapping[str, Any]
    """As JSON values."""
    evidence: Mapping[str, float]
    """Beside the answers."""
    asks: list[Ask] = field(default_factory=list)
    """All questions."""
    exchanges: list[Mapping[str, Any]] = field(default_factory=list)
    """What went over the wire."""
    outcome: Verdict | None = None
    """None where the process died before."""
    redacted: bool = False
    """A secret in the verdict was replaced, so that it has another content than its audit id says."""

    @property
    def verdict(self) -> Verdict:
        """The outcome. Raises AuditError: there is none."""
        if self.outcome is None:
            raise AuditError(f"evaluation {self.number} has no verdict: its process died before")
        return self.outcome


@dataclass
class Record:
    """All of a log."""

    folder: Path
    """Of the log."""
    rubrics: dict[str, Rubric]
    """By version."""
    clips: dict[str, Mapping[str, Any]]
    """Clip lines by the clip's SHA-256."""
    evaluations: dict[int, RecordedEvaluation]
    """By number."""
    head: str
    """Hash of the last line."""
    num_lines: int
    """Of the log."""

    @property
    def store(self) -> MediaStore:
        return MediaStore(self.folder)

    def judged(self, round_number: int | None = None) -> list[RecordedEvaluation]:
        """Evaluations that have a verdict; of one round, or of all."""
        chosen = (e for e in self.evaluations.values() if round_number in (None, e.round_number))
        return [evaluation for evaluation in chosen if evaluation.outcome is not None]

    def rubric(self, evaluation: RecordedEvaluation) -> Rubric:
        return self.rubrics[evaluation.agent.rubric_version]

    def clip(self, evaluation: RecordedEvaluation) -> ClipRef:
        """With its pixels. Raises AuditError: a picture is missing or was changed."""
        return clip_from(self.clips[evaluation.sha256], evaluation.clip_id, self.store)

    def task(self, evaluation: RecordedEvaluation) -> TaskSpec:
        return task_from(evaluation.task, self.store)

    def subject(self, evaluation: RecordedEvaluation) -> Subject:
        """What was judged. Raises AuditError: a picture is missing or was changed."""
        return subject_of(evaluation.sha256, self.task(evaluation))


def subject_of(sha256: str, task: TaskSpec) -> Subject:
    """What two evaluations have in common whose answers count for each other: the clip, and all that is said and shown
    of its task."""
    pictures = (None if one is None else media_sha(one, 0.0) for one in (task.reference_frame, task.goal_image))
    return sha256, task.instruction, task.task_id, task.robot, *pictures


def read_record(folder: Path) -> Record:
    """Read a log, checking its chain. Raises AuditError: a fault, named by its line; a line of another version."""
    record = Record(Path(folder), {}, {}, {}, NO_LINE, 0)
    agents: dict[int, AgentLine] = {}
    asks: dict[int, Ask] = {}
    for line in read_lines(folder):
        record.head, record.num_lines = line.hash, line.number
        try:
            _add_line(record, agents, asks, line)
        except AuditError as error:
            raise AuditError(f"{Path(folder)}, line {line.number} ({line.kind}): {error}") from None
        except (KeyError, TypeError, IndexError) as error:
            raise AuditError(f"{Path(folder)}, line {line.number} ({line.kind}): lacks {error}") from None
    return record


def _add_line(record: Record, agents: dict[int, AgentLine], asks: dict[int, Ask], line: Entry) -> None:
    body = line.body
    if line.kind == "rubric":
        record.rubrics[body["version"]] = rubric_from(body)
    elif line.kind == "agent":
        able = typed(Capabilities, body["capabilities"])
        agents[line.number] = AgentLine(line.number, able, body["rubric_version"], body["settings"])
    elif line.kind == "clip":
        record.clips[body["sha256"]] = body
    elif line.kind == "evaluation":
        evidence = {name: float(value) for name, value in body["evidence"].items()}
        record.evaluations[line.number] = RecordedEvaluation(
            line.number, body["clip_id"], body["sha256"], body["round"], agents[body["agent"]], body["task"], evidence
        )
    elif line.kind in ("ask", "read", "failure", "exchange", "verdict"):
        evaluation = record.evaluations[body["evaluation"]]
        if line.kind == "ask":
            votes = tuple(typed(Vote, vote) for vote in body["votes"])
            media = tuple(typed(MediaItem, item) for item in body["media"])
            asks[line.number] = Ask(body["stage"], tuple(body["components"]), votes, media)
            evaluation.asks.append(asks[line.number])
        elif line.kind == "read":
            asks[body["ask"]].reads.append(typed(Read, body["read"]))
        elif line.kind == "failure":
            asks[body["ask"]].failure = Failure(body["error"], body["reason"], body["cost"])
        elif line.kind == "exchange":
            evaluation.exchanges.append(body)
        else:
            evaluation.outcome, evaluation.redacted = typed(Verdict, body["verdict"]), "redacted" in body


@dataclass(frozen=True)
class VerifyReport:
    """What `verify` found."""

    problems: Sequence[str]
    """None for a sound log."""
    num_lines: int = 0
    """Of the log."""
    num_evaluations: int = 0
    """Of the log."""
    unfinished: int = 0
    """Evaluations without a verdict."""
    head: str = ""
    """Hash of the last line."""
    verdicts: str = ""
    """The hash of all audit ids, in whatever order the clips were judged: equal for equal seeds and equal answers."""


def verify(folder: Path, *, pictures: bool = True, expected_head: str = "") -> VerifyReport:
    """Check the chain, the content hash of every verdict and, unless told otherwise, every picture and clip.

    Args:
        expected_head: a hash that was noted earlier; a log that lacks it was cut, or begun anew.

    Raises:
        AuditError: there is no log.
    """
    if broken := faults(folder):
        return VerifyReport([str(fault) + (" (torn: run `recover`)" if fault.torn else "") for fault in broken])
    try:
        record = read_record(folder)
    except AuditError as error:
        return VerifyReport([str(error)])
    problems = list(_find_problems(record, pictures))
    if expected_head and all(line.hash != expected_head for line in read_lines(folder)):
        problems.append(f"no line has the hash {expected_head}: lines at the end were cut off, or it is another log")
    ids = sorted(e.verdict.audit_id for e in record.judged())
    return VerifyReport(
        problems, record.num_lines, len(record.evaluations), len(record.evaluations) - len(ids), record.head,
        hashlib.sha256("".join(ids).encode()).hexdigest(),
    )


def _find_problems(record: Record, pictures: bool) -> Iterator[str]:
    for evaluation in record.evaluations.values():
        verdict = evaluation.outcome
        about = f"evaluation {evaluation.number} of clip {evaluation.clip_id!r}"
        if verdict is not None and not evaluation.redacted and content_hash(verdict) != verdict.audit_id:
            yield f"{about}: its verdict is not what its audit id says"
        if pictures:
            for name in (evaluation.task[key] for key in ("reference_frame", "goal_image", "actions")):
                try:
                    _ = name is None or record.store.get(name)
                except AuditError as error:
                    yield f"{about}: {error}"
    for sha, body in record.clips.items() if pictures else ():
        try:
            clip = clip_from(body, "", record.store)
        except AuditError as error:
            yield f"clip {sha[:12]}: {error}"
            continue
        if media_sha(clip.frames, clip.fps) != sha:
            yield f"clip {sha[:12]}: its pictures are another clip"
