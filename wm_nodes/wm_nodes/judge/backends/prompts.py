"""The prompts of a chat judge, ordered so that a server's prefix cache is used.

Order: system (constant), media with labels, task, rubric of the stage, question, output rule, what was found before.
Nothing variable stands before the media, and nothing that differs between two questions of a stage before the question.
"""

import base64
import hashlib
import json
import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent import topreward
from wm_nodes.judge.agent.judge import ComponentScore, MediaItem, ReadRequest, Vote
from wm_nodes.judge.agent.rubric import ComponentRubric, PlanningRubric, Rubric
from wm_nodes.judge.agent.types import NUM_LEVELS, PLANNING, ClipRef, Component, Profile, Stage, TaskSpec
from wm_nodes.judge.backends.schemas import AnswerFormat

Part = dict[str, Any]

SYSTEM = (
    "You judge clips that a video model made of a robot at work. You see frames of one clip, each after its index and "
    "time. Trust what you see, not what should have happened. Look first, then judge: a clip may look clean and still "
    "show something impossible. Cite only frames that you were shown. Answer in the form that is asked for, and with "
    "nothing else."
)
LETTERS = ("A", "B", "C", "D", "E")
_ENCODED_IMAGES = 512


class Prompts:
    """Builds the messages of a rubric. Encoded images are kept for a while: a stage sends the same ones many times.

    Args:
        video: send the dense profile as one video, of which a model sees two frames at the price of one image.
    """

    def __init__(self, rubric: Rubric, *, video: bool = False) -> None:
        self.rubric, self._video = rubric, video
        self._encoded: OrderedDict[bytes, str] = OrderedDict()

    def media(self, request: ReadRequest) -> list[Part]:
        """A text and an image part per image of the request, as PNG data URIs; a text and one part for a video."""
        if self._video and request.profile is Profile.D and len(request.media) > 1:
            return self._as_video(request)
        parts: list[Part] = []
        for item in request.media:
            parts.append(_text(item.label))
            uri = self._data_uri(_pixels(item, request.clip, request.task))
            parts.append({"type": "image_url", "image_url": {"url": uri}})
        return parts

    def _as_video(self, request: ReadRequest) -> list[Part]:
        """The frames that were chosen here, in vLLM's form for frames that are not to be sampled again."""
        uris = [self._data_uri(_pixels(item, request.clip, request.task)) for item in request.media]
        labels = _text("video of these frames, in this order: " + ", ".join(item.label for item in request.media))
        return [labels, {"type": "video_url", "video_url": {"url": video_uri(uris)}}]

    def json_question(
        self, media: Sequence[Part], request: ReadRequest, components: Sequence[Component], form: AnswerFormat
    ) -> list[Part]:
        """Ask for a JSON answer on these components."""
        schema = json.dumps(form.model.model_json_schema(), separators=(",", ":"))
        rule = f"Answer with one JSON object, evidence before level. Its JSON schema: {schema}"
        texts = [_text(self._question_text(request.stage, components)), _text(rule)]
        if request.prior:
            texts.append(_text(_prior_text(request.prior)))
        return self._messages(media, request, texts)

    def label_question(
        self, media: Sequence[Part], request: ReadRequest, component: Component, vote: Vote, order: Sequence[int]
    ) -> list[Part]:
        """Ask for one letter. `order` says which level each listed option stands for (levels.option_order)."""
        entry = self.entry(request.stage, component)
        question = entry.question
        if isinstance(entry, ComponentRubric) and (vote.polarity == "negative" or request.stage is Stage.HACK):
            question = entry.defect  # the levels of a pattern say whether the defect is there
        letters = LETTERS[: len(order)]
        options = "\n".join(f"{letter}: {entry.levels[level]}" for letter, level in zip(letters, order))
        rule = f"Answer with one letter, {', '.join(letters[:-1])} or {letters[-1]}, and nothing else."
        return self._messages(media, request, [_text(f"{component}: {question}\n{options}"), _text(rule)])

    def truth_question(self, media: Sequence[Part], request: ReadRequest) -> list[Part]:
        """Ask whether the frames complete the task (topreward.py)."""
        statement = _text(topreward.STATEMENT.format(instruction=request.task.instruction))
        return [{"role": "system", "content": topreward.SYSTEM}, {"role": "user", "content": [*media, statement]}]

    def entry(self, stage: Stage, component: Component) -> ComponentRubric | PlanningRubric:
        """What the rubric says of a component, a hacking pattern, or planning. Raises ValueError: it says nothing."""
        if stage is Stage.PLAN and component == PLANNING:
            return self.rubric.planning
        known: dict[str, ComponentRubric] = (
            dict(self.rubric.hack.patterns)
            if stage is Stage.HACK
            else {name: entry for part in self.rubric.stages.values() for name, entry in part.components.items()}
        )
        if component not in known:
            raise ValueError(
                f"rubric {self.rubric.version} has no {component!r} for {stage}; known: {', '.join(sorted(known))}"
            )
        return known[component]

    def _messages(self, media: Sequence[Part], request: ReadRequest, question: Sequence[Part]) -> list[Part]:
        task = request.task
        about = f"Instruction to the robot: {task.instruction}\nRobot: {task.robot}"
        content = [*media, _text(about), _text(self._rubric_text(request.stage)), *question]
        return [{"role": "system", "content": SYSTEM}, {"role": "user", "content": content}]

    def _rubric_text(self, stage: Stage) -> str:
        """All the stage's components with their levels, whichever are asked for: the same for every question."""
        if stage is Stage.PLAN:
            return f"planning: {self.rubric.planning.question}\n{_levels(self.rubric.planning.levels)}"
        if stage is Stage.HACK:
            patterns = self.rubric.hack.patterns.items()
            return "\n".join(f"{name}: {entry.defect}" for name, entry in patterns)
        stages = [self.rubric.stages[stage]] if stage in self.rubric.stages else list(self.rubric.stages.values())
        entries = [entry for part in stages for entry in part.components.items()]
        return "\n\n".join(f"{name}: {entry.question}\n{_levels(entry.levels)}" for name, entry in entries)

    def _question_text(self, stage: Stage, components: Sequence[Component]) -> str:
        if stage is Stage.PLAN:
            return "Judge the clip as a whole. List the components with a visible problem, worst first, or none."
        if stage is Stage.HACK:
            return "For each pattern: is it present in the clip?"
        if stage is Stage.TC and len(components) == 1:
            return f"Name the end state that the instruction requires and the one you see, then judge {components[0]}."
        if stage is Stage.REFLECT:
            return (
                f"These frames are new. Check the earlier levels of {', '.join(components)} against them. Propose a "
                "change only where a frame that you cite shows it. Is what was found free of contradictions?"
            )
        return f"Judge {', '.join(components)}."

    def _data_uri(self, image: UInt8Array) -> str:
        key = hashlib.sha256(f"{image.shape} ".encode() + np.ascontiguousarray(image).tobytes()).digest()
        if key not in self._encoded:
            self._encoded[key] = data_uri(image)
            if len(self._encoded) > _ENCODED_IMAGES:
                self._encoded.popitem(last=False)
        self._encoded.move_to_end(key)
        return self._encoded[key]


def data_uri(image: UInt8Array) -> str:
    """An RGB image, uint8 (H, W, 3), as a PNG data URI; equal pixels, equal bytes. Raises ValueError: no such image."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"an image must be uint8 (H, W, 3), got {image.dtype} {image.shape}")
    encoded = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1]
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()


def video_uri(images: Sequence[str]) -> str:
    """One data URI of several PNG data URIs: vLLM's "video/jpeg", frames separated by commas, decoded one by one."""
    return "data:video/jpeg;base64," + ",".join(uri.partition(",")[2] for uri in images)


def with_problem(messages: Sequence[Part], problem: str) -> list[Part]:
    """The same question with the reason for refusing the last answer at its end, so that the prefix stays."""
    *first, last = messages
    note = _text(f"Your last answer was refused: {problem[:500]}. Answer again, correctly.")
    return [*first, {**last, "content": [*last["content"], note]}]


def _pixels(item: MediaItem, clip: ClipRef, task: TaskSpec) -> UInt8Array:
    if item.kind == "clip":
        if not 0 <= item.index < len(clip.frames):
            raise ValueError(f"frame {item.index} is asked for, clip {clip.clip_id} has {len(clip.frames)}")
        frame: UInt8Array = clip.frames[item.index]
        return frame
    if item.kind == "goal":
        if task.goal_image is None:
            raise ValueError(f"a goal image is asked for, task {task.task_id} has none")
        return task.goal_image
    return task.reference_frame


def _prior_text(prior: Sequence[ComponentScore]) -> str:
    levels = ("unknown" if (level := prior_level(score)) is None else level for score in prior)
    lines = [f"{score.component}: level {level}. {score.evidence_text}" for score, level in zip(prior, levels)]
    return "Found before, possibly wrong:\n" + "\n".join(lines)


def prior_level(score: ComponentScore) -> int | None:
    """The level, 0 to 4, nearest to an earlier score; None where there is no number."""
    return None if math.isnan(score.s) else round((NUM_LEVELS - 1) * score.s)


def _levels(levels: Sequence[str]) -> str:
    return "\n".join(f"  {number}: {text}" for number, text in enumerate(levels))


def _text(text: str) -> Part:
    return {"type": "text", "text": text}
