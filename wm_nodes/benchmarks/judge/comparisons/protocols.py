"""What each comparison reward asks, and how its answer is read. Sources: see the package. No transport here."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wm_nodes.judge.backends.schemas import AnswerError, json_object

Parts = Mapping[str, float]
UNIFIED_DIMENSIONS = (
    "visual quality", "temporal consistency", "dynamic degree", "text-to-video alignment", "factual consistency",
)


@dataclass(frozen=True)
class PointwiseProtocol:
    """A score of one clip.

    question: of the instruction. read: the parts as the protocol gives them, or AnswerError. value: of the parts, in
    [0, 1]. frames: this many, evenly spaced; or None: `fps` per second of the clip, 2 at least.
    """

    question: Callable[[str], str]
    read: Callable[[str], Parts]
    value: Callable[[Parts], float]
    frames: int | None = 8
    fps: float = 2.0


@dataclass(frozen=True)
class PairwiseProtocol:
    """Which of two clips is better. read: preference of the first in [0, 1], and the parts it is made of."""

    question: Callable[[str], str]
    read: Callable[[str], tuple[float, Parts]]
    frames: int = 8


class _StrictAnswer(BaseModel):
    model_config = ConfigDict(extra="forbid")


Ten = Annotated[float, Field(ge=0, le=10)]


class _VideoAlign(_StrictAnswer):
    VQ: Ten
    MQ: Ten
    TA: Ten


class _Single(_StrictAnswer):
    score: Ten


class _Dimension(BaseModel):
    name: str
    score_1: Ten
    score_2: Ten


class _Category(BaseModel):
    name: str
    dims: Annotated[list[_Dimension], Field(min_length=1)]


class _Flex(BaseModel):
    categories: Annotated[list[_Category], Field(min_length=3)]
    winner: Literal["Video 1", "Video 2"]


def _video_align_question(instruction: str) -> str:
    return (
        "Rate this generated video on three criteria, each for itself, from 0 (worst) to 10 (best).\n"
        "VQ, visual quality of the single frames: is everything sensible, sharp, detailed, pleasing and harmless?\n"
        "MQ, motion quality: is the video stable from frame to frame, natural and within physical laws, fluid, without "
        "cut-and-paste edges, clear while things move? A video that hardly moves gets a low rating.\n"
        "TA, text alignment: do subject, motion, environment, style and camera match the prompt?\n"
        f'Prompt: "{instruction}"\n'
        'Answer with one JSON object and nothing else: {"VQ": number, "MQ": number, "TA": number}'
    )


def _unified_question(instruction: str) -> str:
    lines = "\n".join(f"{name}: <1 to 4>" for name in UNIFIED_DIMENSIONS)
    return (
        "You see frames of a generated video, in order. Score it on five dimensions with 1 bad, 2 average, 3 good or "
        "4 real or perfect: visual quality (sharpness, resolution, brightness, colour), temporal consistency (things "
        "stay what they are), dynamic degree (how much changes), text-to-video alignment (content against the prompt), "
        "factual consistency (common sense and facts). Then give a final score from 1 to 10 based on the five.\n"
        f"Answer in this form and with nothing else:\n{lines}\nFinal Score: <1 to 10>\n"
        f"Text Prompt: [{instruction}]"
    )


def _single_question(instruction: str) -> str:
    return (
        f'A robot was told: "{instruction}". How good is this video of it, from 0 (worst) to 10 (best)?\n'
        'Answer with one JSON object and nothing else: {"score": number}'
    )


def _flex_question(instruction: str) -> str:
    return (
        "Compare two generated videos of one prompt. First come the frames of video 1, then those of video 2.\n"
        "Use three categories: A, semantic alignment and accuracy; B, video quality and dynamic realism; C, narrative, "
        "aesthetics and cinematography; and a category D of your own if the prompt calls for one. In each, choose 3 to "
        "5 sub-dimensions that tell these two videos apart. In every sub-dimension share exactly 10 points between the "
        "two videos and give the visible evidence for each. Then name the winner.\n"
        f"Prompt: [{instruction}]\n"
        'Answer with one JSON object and nothing else: {"categories": [{"name": text, "dims": [{"name": text, '
        '"reason_1": text, "reason_2": text, "score_1": 0 to 10, "score_2": 0 to 10}], "cat_reason": text, '
        '"cat_winner": "Video 1" or "Video 2"}], "reason": text, "winner": "Video 1" or "Video 2"}'
    )


def read_unified(text: str) -> Parts:
    """The five dimensions (1 to 4) and "Final Score" (1 to 10) of an answer in text lines.

    Raises:
        AnswerError: one is missing, there twice, or out of range.
    """
    parts = {}
    for name in (*UNIFIED_DIMENSIONS, "Final Score"):
        numbers = re.findall(rf"^\W*{re.escape(name)}\W*:\W*([\d.]+)\W*$", text, re.IGNORECASE | re.MULTILINE)
        high = 10 if name == "Final Score" else 4
        if len(numbers) != 1:
            raise AnswerError(f"{name!r} is there {len(numbers)} times instead of once")
        try:
            value = float(numbers[0])
        except ValueError:
            raise AnswerError(f"{numbers[0]!r} is no number") from None
        if not 1 <= value <= high:
            raise AnswerError(f"{name} must be 1 to {high}, got {numbers[0]}")
        parts[name] = value
    return parts


def read_flex(text: str) -> tuple[float, Parts]:
    """Preference of video 1: the mean share of points over all sub-dimensions; and that share per category.

    Raises:
        AnswerError: not that JSON, points that do not sum to 10, or a winner whom the points contradict.
    """
    answer = _parse(_Flex, text)
    shares: dict[str, float] = {}
    points: list[float] = []
    for category in answer.categories:
        for dim in category.dims:
            if abs(dim.score_1 + dim.score_2 - 10) > 1e-6:
                raise AnswerError(f"{dim.name}: {dim.score_1:g} + {dim.score_2:g} is not 10")
        mine = [dim.score_1 / 10 for dim in category.dims]
        shares[category.name] = sum(mine) / len(mine)
        points += mine
    preference = sum(points) / len(points)
    if preference != 0.5 and (preference > 0.5) != (answer.winner == "Video 1"):
        raise AnswerError(f"the winner is {answer.winner}, the points say {preference:.2f} for Video 1")
    return preference, shares


def _reader(model: type[BaseModel]) -> Callable[[str], Parts]:
    return lambda text: _parse(model, text).model_dump()


def _parse(model: type[Any], text: str) -> Any:
    try:
        return model.model_validate(json.loads(json_object(text)))
    except ValidationError as error:
        first = error.errors()[0]
        raise AnswerError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    except ValueError as error:
        raise AnswerError(str(error) or "no JSON object") from None


POINTWISE = {
    "videoalign": PointwiseProtocol(_video_align_question, _reader(_VideoAlign), lambda p: sum(p.values()) / 30, None),
    "unifiedreward": PointwiseProtocol(_unified_question, read_unified, lambda p: (p["Final Score"] - 1) / 9),
    "single": PointwiseProtocol(_single_question, _reader(_Single), lambda p: p["score"] / 10),
}
"""By name. VideoAlign's public total is a sum of normalised regressions; over ratings, the sum of 0 to 10 over 30."""
PAIRWISE = {"unifiedreward-flex": PairwiseProtocol(_flex_question, read_flex)}
