"""A judge in this process that no fault was ever shown: a clip is refused for what is strange in it (RA-27).

It needs a world model of the clip's scene and normal ranges in its folder (wm judge calibrate). It is deterministic:
all votes of a component and the second read of a reflection get the same answer.
"""

import asyncio
import hashlib
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.model_folder import ModelFolderError, files_sha256
from wm_nodes.environments.object_reader import reader_of
from wm_nodes.judge.agent.judge import Capabilities, Cost, Health, JudgeError, Read, ReadRequest, reads_of
from wm_nodes.judge.agent.levels import first_vote
from wm_nodes.judge.agent.types import (
    NUM_LEVELS,
    PLANNING,
    TASK_COMPLETION,
    ClipRef,
    Component,
    Evidence,
    Stage,
    Status,
    TaskSpec,
)
from wm_nodes.judge.one_class.calibration import words_of
from wm_nodes.judge.one_class.imagination import model_numbers
from wm_nodes.judge.one_class.pictures import HUES, picture_numbers, things_in
from wm_nodes.judge.one_class.ranges import COMPONENTS, KEPT, NormalRanges, file_of, load_ranges, strides_of
from wm_nodes.world_model import WorldModels, load_model_folder

REVISION = "3"
"""Raised whenever the same ranges give other answers, so that two versions have two identities."""
CACHED_CLIPS = 64
"""Clips whose numbers are kept, for the stages of one verdict."""
FAR_RATE = 1.5
"""A clip whose frame rate is so many times another than that of the nearest ranges is not judged."""
STEEPNESS = 40.0
"""Of the failure probability around the limit: 0.5 there, 0.98 a tenth above it."""
FAIL_LEVEL, PASS_LEVEL = 1, 4
"""A component that fails is "clearly wrong", one that passes "clean"."""
PATTERNS: Mapping[str, tuple[Component, ...]] = {
    "occlusion": ("clarity",), "motion": ("temporal",), "background": ("background",),
    "physics": ("interaction", "deformation", "geometry"),
}
"""Components whose failure is each hacking pattern's."""
KNOWN = frozenset({*COMPONENTS.values(), *PATTERNS, PLANNING, TASK_COMPLETION})
"""Everything that it reads."""


@dataclass(frozen=True)
class Finding:
    """What was measured of one clip."""

    unfit: str
    """Why it cannot be judged, or ""."""
    worst: Mapping[Component, tuple[float, str]]
    """By component its strangest number in spreads, and which that is."""
    done: Mapping[str, float]
    """Done signal at the end, by task."""
    naming: tuple[Status, str]
    """Whether what the instruction names is seen: OK, ERROR for no, ABSTAIN for unknown; and why."""


class OneClassJudge:
    """A Judge over a world model and its normal ranges.

    Answers ABSTAIN, with a reason, for clips of another size or length, for instructions in words that the recordings
    have not, and for the completion of tasks that the world model does not know.

    Args:
        folder: of the world model, with normal ranges in it.
        conformal: a share, e.g. 0.9, below KEPT: it abstains, too, on what is stranger than this share of the
            recordings and not beyond the limit. 0: it always decides.
        device: the setting `device` (core/device.py).

    Raises:
        ModelFolderError: the folder holds no world model, or no ranges of this model.
    """

    def __init__(self, folder: Path, conformal: float = 0.0, device: str = CPU) -> None:
        self._folder = folder
        self._models: WorldModels = load_model_folder(folder, compute_device(device))
        self._reader = reader_of(folder, self._models.spec)
        self._ranges = ranges_of(folder, self._models.manifest)
        self._conformal = conformal
        self._sure = {
            stride: ranges.limit(conformal) if conformal else math.inf for stride, ranges in self._ranges.items()
        }
        self._cache: OrderedDict[str, tuple[NormalRanges, Finding]] = OrderedDict()
        self._lock = threading.Lock()
        self._num_reads = self._num_abstained = 0

    @property
    def capabilities(self) -> Capabilities:
        """What it reads, and who it is."""
        return Capabilities(
            self.name, "embedded", f"one-class {self.sha256[:12]}", REVISION, KNOWN, card=self.card
        )

    @cached_property
    def sha256(self) -> str:
        """Of the ranges of every stride, which name the world model."""
        return hashlib.sha256("".join(ranges.sha256 for ranges in self._ranges.values()).encode()).hexdigest()

    @property
    def name(self) -> str:
        """Of its ranges and its share."""
        return f"embedded:{self.sha256[:12]}" + (f"@{self._conformal:g}" if self._conformal else "")

    @property
    def card(self) -> str:
        """What it was calibrated on."""
        lines = [f"one-class judge {self.sha256[:12]} of {self._folder.name}"]
        for stride, ranges in self._ranges.items():
            lines.append(
                f"every {stride}. step: {ranges.story.get('recordings')} recordings; "
                f"limit {ranges.limit():.2f} spreads at {KEPT:.0%}; {ranges.lengths[0]} to {ranges.lengths[1]} frames; "
                f"tasks {', '.join(ranges.done)}"
            )
        return "\n".join(lines)

    async def read(self, request: ReadRequest) -> list[Read]:
        """Answer every component once per vote. Raises JudgeError: an unmeasurable clip, or an unknown component."""
        if unknown := set(request.components) - KNOWN:
            raise JudgeError(f"the embedded judge does not read {', '.join(sorted(unknown))}")
        started = time.monotonic()
        try:
            ranges, finding = await asyncio.to_thread(self._find, request.clip, request.task)
        except ValueError as error:
            raise JudgeError(f"no numbers: {error}") from error
        cost = Cost(calls=1, images=len(request.media), wall_s=time.monotonic() - started)
        is_hack = request.stage is Stage.HACK
        reads = reads_of(request, cost, lambda name: self._answer(name, is_hack, request.task, ranges, finding))
        self._num_reads += len(reads)
        self._num_abstained += sum(read.status is Status.ABSTAIN for read in reads)
        return reads

    def evidence(self, clip: ClipRef, task: TaskSpec) -> Evidence:
        """How strange what each component speaks about is, 1 at the limit; {} of a clip that it cannot judge."""
        try:
            ranges, finding = self._find(clip, task)
        except ValueError:
            return {}
        return {name: score / ranges.limit() for name, (score, _) in finding.worst.items()}

    async def health(self) -> Health:
        """Always available; details count the reads and the abstentions."""
        return Health(True, "", {"reads": float(self._num_reads), "abstained": float(self._num_abstained)})

    def _find(self, clip: ClipRef, task: TaskSpec) -> tuple[NormalRanges, Finding]:
        """The finding of a clip and its ranges, measured once."""
        key = f"{clip.sha256} {task.instruction} {task.task_id} {hash(task.reference_frame.tobytes())}"
        with self._lock:
            if key not in self._cache:
                self._cache[key] = self._measure(clip, task)
                while len(self._cache) > CACHED_CLIPS:
                    self._cache.popitem(last=False)
            return self._cache[key]

    def _measure(self, clip: ClipRef, task: TaskSpec) -> tuple[NormalRanges, Finding]:
        """Raises ValueError: a number of the clip is not finite."""
        ranges = nearest_ranges(self._ranges, self._models.manifest, clip.fps)
        reason = unfit_reason(self._ranges, self._models.manifest, clip.frames.shape, clip.fps)
        if not reason and task.reference_frame.shape != clip.frames.shape[1:]:
            height, width = task.reference_frame.shape[:2]
            reason = f"the reference frame is {height} x {width} px, the clip is not"
        if reason:
            return ranges, Finding(reason, {}, {}, (Status.OK, ""))
        side, origin = self._models.spec.height, np.asarray(ranges.origin, np.float32)
        numbers = picture_numbers(clip.frames, task.reference_frame, side, ranges.still)
        drawn, done = model_numbers(
            self._models, clip.frames, ranges.stride, origin, ranges.height_m, self._reader
        )
        numbers |= drawn
        if lost := [name for name, value in (numbers | done).items() if not math.isfinite(value)]:
            raise ValueError(f"{', '.join(lost)} of clip {clip.clip_id} is not finite; check the world model")
        strange = ranges.strangeness(numbers)
        worst: dict[Component, tuple[float, str]] = {}
        for name, component in COMPONENTS.items():
            worst[component] = max(worst.get(component, (-math.inf, "")), (strange[name], name))
        return ranges, Finding("", worst, done, self._naming(task, ranges))

    def _naming(self, task: TaskSpec, ranges: NormalRanges) -> tuple[Status, str]:
        """Whether every coloured thing that the instruction names is in the reference frame."""
        colours = dict[str, set[str]]()
        for pair in ranges.words:
            first, second = pair.split()
            if first in HUES:
                colours.setdefault(second, set()).add(first)
        side = self._models.spec.height
        views = [task.reference_frame[:, i * side : (i + 1) * side] for i, stays in enumerate(ranges.still) if stays]
        seen = {colour for view in views for colour in things_in(view)}
        words = words_of(task.instruction)
        for colour, noun in zip(words, [*words[1:], "thing"]):
            if colour not in HUES:
                continue
            if colour not in seen:
                there = ", ".join(sorted(seen)) or "none"
                return Status.ERROR, f"the {colour} {noun} is not in the first frame; colours there: {there}"
            if len(colours.get(noun, ())) == 1 and colour not in colours[noun]:
                return Status.ERROR, f"the {noun} here is {min(colours[noun])}, not {colour}"
        known = {word for pair in ranges.words for word in pair.split()} | set(HUES)
        if strange := [word for word in dict.fromkeys(words) if word not in known]:
            return Status.ABSTAIN, f"the recordings' instructions do not have {', '.join(strange)}"
        return Status.OK, ""

    def _answer(self, name: Component, hack: bool, task: TaskSpec, ranges: NormalRanges, finding: Finding) -> Read:
        """The answer to one component, or, of the stage HACK, to one pattern."""
        if finding.unfit:
            return _abstention(name, finding.unfit)
        if hack:
            score, number = max(finding.worst[component] for component in PATTERNS[name])
            return _decision(name, self._p_fail(score, ranges), _text(score, number, ranges))
        if name == PLANNING:
            return self._planning(ranges, finding)
        if name == TASK_COMPLETION:
            return self._completion(task, ranges, finding)
        status, reason = finding.naming if name == "objective" else (Status.OK, "")
        if status is Status.ERROR:
            return _decision(name, 1.0, reason)
        if status is Status.ABSTAIN:
            return _abstention(name, reason)
        score, number = finding.worst[name]
        text = _text(score, number, ranges)
        if self._sure[ranges.stride] < score <= ranges.limit():
            more = f"stranger than {self._conformal:.0%} of the recordings, and not beyond the limit"
            return _abstention(name, f"{text}: {more}")
        return _decision(name, self._p_fail(score, ranges), text)

    def _planning(self, ranges: NormalRanges, finding: Finding) -> Read:
        """Always "good"; the failing components are looked at first.

        A lower level would move weight to quality: of an undone task, a further fault would raise the reward.
        """
        p_fail = {name: self._p_fail(score, ranges) for name, (score, _) in finding.worst.items()}
        if finding.naming[0] is Status.ERROR:
            p_fail["objective"] = 1.0
        focus = tuple(sorted((name for name in p_fail if p_fail[name] >= 0.5), key=lambda name: -p_fail[name]))
        return Read(PLANNING, (0.0, 0.0, 0.0, 1.0), "embedded", first_vote(0), focus=focus)

    def _completion(self, task: TaskSpec, ranges: NormalRanges, finding: Finding) -> Read:
        """Done at even odds where the done signal is at the task's threshold."""
        if task.task_id not in ranges.done:
            known = ", ".join(ranges.done) or "none"
            return _abstention(TASK_COMPLETION, f"not calibrated on task {task.task_id!r}, only on {known}")
        threshold, signal = ranges.done[task.task_id], finding.done[task.task_id]
        q = 1 / (1 + math.exp(_log_odds(threshold) - _log_odds(signal)))
        return _decision(TASK_COMPLETION, 1 - q, f"done signal {signal:.3f}, done from {threshold:.3f}")

    def _p_fail(self, score: float, ranges: NormalRanges) -> float:
        """Of a score in spreads."""
        return 1 / (1 + math.exp(min(50.0, STEEPNESS * (1 - score / ranges.limit()))))


def ranges_of(folder: Path, manifest: Mapping[str, Any]) -> dict[int, NormalRanges]:
    """The ranges of a world model's folder by stride; the weights are not read.

    Raises:
        ModelFolderError: there are none, they are damaged, or they are of another world model.
    """
    found = {stride: load_ranges(folder, stride) for stride in strides_of(folder) or (1,)}
    for stride, ranges in found.items():
        if ranges.world_model != files_sha256(manifest):
            raise ModelFolderError(
                f"{file_of(folder, stride)} was made for another world model; make it anew: "
                f"wm judge calibrate {folder} BAG --stride {stride}"
            )
    return found


def nearest_ranges(known: Mapping[int, NormalRanges], manifest: Mapping[str, Any], fps: float) -> NormalRanges:
    """The ranges of clips with so many frames per second; the nearest where there are none."""
    wanted = 1 / (manifest["spec"]["control_period_s"] * fps)
    return known[min(known, key=lambda stride: abs(math.log(stride / wanted)))]


def unfit_reason(
    known: Mapping[int, NormalRanges], manifest: Mapping[str, Any], shape: tuple[int, ...], fps: float | None = None
) -> str:
    """Why no clip of this shape (frames, height, width, 3) can be judged, or "". fps: None: of the first ranges."""
    control_hz = 1 / manifest["spec"]["control_period_s"]
    ranges = nearest_ranges(known, manifest, fps or control_hz / min(known))
    if fps and abs(math.log(ranges.stride * fps / control_hz)) > math.log(FAR_RATE):
        rates = ", ".join(f"{control_hz / stride:g}" for stride in known)
        return f"{fps:g} frames per second, judged are {rates}; for others: wm judge calibrate ... --stride"
    height, width = manifest["spec"]["height"], manifest["spec"]["width"]
    if tuple(shape[1:3]) != (height, width):
        return f"{shape[1]} x {shape[2]} px, judged are {height} x {width} px"
    if not ranges.lengths[0] <= shape[0] <= ranges.lengths[1]:
        return f"{shape[0]} frames, judged are {ranges.lengths[0]} to {ranges.lengths[1]}"
    return ""


def _abstention(name: Component, reason: str) -> Read:
    return Read(name, (), "embedded", first_vote(0), status=Status.ABSTAIN, reason=reason)


def _decision(name: Component, p_fail: float, text: str) -> Read:
    levels = [0.0] * NUM_LEVELS
    levels[FAIL_LEVEL], levels[PASS_LEVEL] = p_fail, 1 - p_fail
    return Read(name, tuple(levels), "embedded", first_vote(0), evidence_text=text)


def _log_odds(p: float) -> float:
    p = min(max(p, 1e-6), 1 - 1e-6)
    return math.log(p / (1 - p))


def _text(score: float, number: str, ranges: NormalRanges) -> str:
    return f"{number} {score:.2f} spreads above its median, normal to {ranges.limit():.2f}"
