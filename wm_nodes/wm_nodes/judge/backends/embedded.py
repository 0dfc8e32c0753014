"""A judge in this process: no server, no download, no GPU (RA-17 to RA-20).

It reads the evidence of wm_nodes.judge.evidence with the heads of a trained folder. It is deterministic: all votes of a
component and the second read of a reflection get the same answer.

    agent = RewardAgent(EmbeddedJudge(load_head(folder)), load_rubric())
"""

import asyncio
import hashlib
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from wm_nodes.config.shipped import PRETRAINED
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.agent.judge import Capabilities, Cost, Health, JudgeError, Read, ReadRequest, reads_of
from wm_nodes.judge.agent.levels import first_vote, p_fail_of
from wm_nodes.judge.agent.types import PLANNING, ClipRef, Component, Evidence, Stage, Status, TaskSpec
from wm_nodes.judge.evidence.clip import clip_evidence
from wm_nodes.judge.evidence.head import HACK, TASK_COMPLETION, JudgeHead, components_of

TRANSPORT = "embedded"
REVISION = "2"
"""Raised whenever the same head gives other answers, so that two versions have two identities."""
CACHED_CLIPS = 64
"""Clips whose evidence is cached, for the stages of one verdict."""
BLIND_AUROC = 0.75
"""A component with a smaller AUROC on the validation part is not answered."""
TEXT_LIMIT = 240
MAX_FRAMES = 64


class EmbeddedJudge:
    """A Judge over a trained head. Deterministic: equal clips and tasks get equal answers.

    Answers ABSTAIN, with a reason, for clips of another size or length than it was trained on, for clips unlike any in
    training, for components that it was measured not to see, and for the completion of tasks that it was not trained on
    or has no geometry of.

    Args:
        conformal: a coverage, e.g. 0.9: it abstains, too, where p_fail lies in between, so that of the clips like its
            validation part at most a tenth of those that fail a component are said to pass it, and the other way
            round. 0: it always decides.

    Raises:
        ValueError: the head was not calibrated for this coverage.
    """

    def __init__(self, head: JudgeHead, conformal: float = 0.0) -> None:
        self._head = head
        self._coverage = conformal
        self._limits = head.conformal(conformal) if conformal else {}
        measured: Mapping[str, Mapping[str, float]] = head.story.get("validation", {})
        self.blind = frozenset(
            name for name in head.questions if not measured.get(name, {}).get("auroc", 1.0) >= BLIND_AUROC
        )
        self._cache: OrderedDict[str, Evidence] = OrderedDict()
        self._lock = threading.Lock()
        self._num_reads = self._num_abstained = 0

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(
            self.name, TRANSPORT, f"judge {self._head.sha256[:12]}", REVISION,
            frozenset(name.removeprefix(HACK) for name in self._head.questions), max_frames=MAX_FRAMES,
            deterministic=True, card=self.card,
        )

    @property
    def name(self) -> str:
        """Two coverages are two judges."""
        return f"{TRANSPORT}:{self._head.sha256[:12]}" + (f"@{self._coverage:g}" if self._coverage else "")

    @property
    def card(self) -> str:
        """What it can see and how well, on the validation part; one line per component."""
        story, head = self._head.story, self._head
        lines = [
            f"embedded judge {head.sha256[:12]}: {head.picture_size[0]} x {head.picture_size[1]} px, {head.lengths[0]} "
            f"to {head.lengths[1]} frames; tasks {', '.join(story.get('tasks', []))}; cameras "
            f"{', '.join(story.get('cameras', []))}"
        ]
        for name, metrics in story.get("validation", {}).items():
            blind = "  not answered: too weak" if name in self.blind else ""
            lines.append(
                f"{name:16} balanced accuracy {metrics['balanced_accuracy']:.2f}, ECE {metrics['ece']:.3f}, "
                f"{metrics['fails']} fails of {metrics['n']}{blind}"
            )
        return "\n".join(lines)

    async def read(self, request: ReadRequest) -> list[Read]:
        """Answer every component once per vote. Raises JudgeError: an unmeasurable clip, or no head for a component."""
        prefix = HACK if request.stage is Stage.HACK else ""
        if unknown := [name for name in request.components if prefix + name not in self._head.questions]:
            raise JudgeError(f"the embedded judge has no head for {', '.join(unknown)}")
        started = time.monotonic()
        try:
            foreign, evidence = await asyncio.to_thread(self._measure, request.clip, request.task)
        except ValueError as error:
            raise JudgeError(f"no evidence: {error}") from error
        cost = Cost(calls=1, images=len(request.media), wall_s=time.monotonic() - started)
        reads = reads_of(request, cost, lambda name: self._answer(prefix + name, request.task, foreign, evidence))
        self._num_reads += len(reads)
        self._num_abstained += sum(read.status is Status.ABSTAIN for read in reads)
        return reads

    async def health(self) -> Health:
        """Always available; details count the reads and the abstentions."""
        counts = {"reads": float(self._num_reads), "abstained": float(self._num_abstained)}
        return Health(True, "", counts)

    def evidence(self, clip: ClipRef, task: TaskSpec) -> Evidence:
        """The evidence of a clip by name; cached. Raises ValueError: frames or reference of a wrong shape or type."""
        key = hashlib.sha256(
            f"{clip.sha256} {task.instruction} {task.reference_frame.shape} ".encode() + task.reference_frame.tobytes()
        ).hexdigest()
        if (numbers := self._cache.get(key)) is None:
            head = self._head
            frames, reference = head.seen(clip.frames), head.seen(task.reference_frame)
            numbers = MappingProxyType(clip_evidence(head.segmenter, frames, reference, task.instruction, head.readers))
            with self._lock:
                self._cache[key] = numbers
                while len(self._cache) > CACHED_CLIPS:
                    self._cache.popitem(last=False)
        return numbers

    def _measure(self, clip: ClipRef, task: TaskSpec) -> tuple[str, FloatArray]:
        """Why the clip cannot be judged, or "", and its evidence (1, F)."""
        head = self._head
        if reason := unfit_reason(head, clip.frames.shape):
            return reason, np.zeros((1, len(head.names)), np.float32)
        row = head.row(self.evidence(clip, task))
        distance, limit = float(head.familiarity.distance(row)[0]), head.familiarity.limit
        if distance > limit:
            return f"unlike all training clips: distance {distance:.2f}, at most {limit:.2f} is judged", row
        return "", row

    def _answer(self, target: str, task: TaskSpec, foreign: str, row: FloatArray) -> Read:
        """What the head says of a target; component, vote and cost are the caller's."""
        vote = first_vote(0)
        if reason := foreign or self._silence_reason(target, task):
            return Read(target, (), "embedded", vote, status=Status.ABSTAIN, reason=reason)
        levels, text = self._head.levels(target, row), self._head.evidence_text(target, row)[:TEXT_LIMIT]
        if reason := self._doubt_reason(target, levels):
            return Read(target, (), "embedded", vote, status=Status.ABSTAIN, reason=reason, evidence_text=text)
        focus = self._focus(row) if target == PLANNING else ()
        return Read(target, levels, "embedded", vote, evidence_text=text, focus=focus)

    def _silence_reason(self, name: str, task: TaskSpec) -> str:
        """Why this target is not answered, or ""."""
        if name in self.blind:
            return f"the embedded judge does not see {name}: validation AUROC is below {BLIND_AUROC}"
        words, trained = f" {task.instruction.lower()} ", self._head.story.get("tasks", [])
        if name == TASK_COMPLETION and task.task_id not in trained:
            return f"not trained on task {task.task_id!r}, only on {', '.join(trained)}: what is done there?"
        if name == TASK_COMPLETION and not (" into " in words or " above " in words):
            return f"no geometry for the task {task.instruction!r}: known are '.. into the .. target', '.. above ..'"
        return ""

    def _doubt_reason(self, name: str, levels: tuple[float, ...]) -> str:
        """Why the conformal limits allow no answer, or ""."""
        if name not in self._limits:
            return ""
        (low, high), p_fail = self._limits[name], p_fail_of(levels)
        if p_fail >= low if p_fail < 0.5 else p_fail <= high:
            other = f"clips that fail begin at {low:.3f}" if p_fail < 0.5 else f"clips that pass end at {high:.3f}"
            return f"p_fail {p_fail:.3f} leaves both possible at {self._coverage:.0%} coverage: {other}"
        return ""

    def _focus(self, row: FloatArray) -> tuple[Component, ...]:
        """Components that rather fail than pass, worst first."""
        names = [name for name in components_of(self._head.questions) if name not in self.blind]
        p_fail = {name: p_fail_of(self._head.levels(name, row)) for name in names}
        return tuple(sorted((name for name in names if p_fail[name] >= 0.5), key=lambda name: -p_fail[name]))


def unfit_reason(head: JudgeHead, shape: tuple[int, ...]) -> str:
    """Why no number can be had from a clip of this shape (frames, height, width, 3), or ""."""
    num_frames, height, width = shape[:3]
    if (height, width) != head.picture_size:
        return f"{height} x {width} px, judged are {head.picture_size[0]} x {head.picture_size[1]} px; scale the clip"
    fewest, most = head.lengths
    if not fewest <= num_frames <= most:
        return f"{num_frames} frames, judged are {fewest} to {most}"
    return ""


def shipped_head() -> Path:
    """The folder of the judge inside the package, of the benchmark's clips."""
    return PRETRAINED / "clip_judge"


def shipped_heads() -> list[Path]:
    """The folders of all judges inside the package: of the benchmark's clips, and of what the loops' policy sees."""
    return [shipped_head(), PRETRAINED / "policy_judge"]
