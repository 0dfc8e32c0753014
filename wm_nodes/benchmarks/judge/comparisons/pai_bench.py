"""PAI-Bench's robot protocol: domain questions answered yes or no, and quality metrics.

Known from its public code (SHI-Labs/physical-ai-bench, predict/) and its paper (arXiv 2512.01989): one JSON file of
questions per video with `uid`, `question`, `answer`, `index2ans` and `task`; a vision-language model sees the video at
2 frames per second and answers at temperature 0; an answer is right if it holds the expected word and not the other
one; the file's name begins with the category (`robot_`); accuracy is the mean over questions and seeds. Subject and
background consistency are those of VBench. From Table 1 of "Reward as an Agent": Quality is the mean of the eight
metrics, Overall the mean of Quality and Domain (its rows agree to the last digit). Unlike there, an answer that is no
answer is left out and counted, not wrong.
Inferred: the wording of the prompts, which the public tree does not hold; the image-to-video terms, written here as the
same mean with the conditioning image in place of the first frame.
Not computed here, because they need networks and weights of their own: aesthetic, imaging quality, motion smoothness,
overall consistency; give their values, or the summary says which are missing.

Shapes: T frames, D features.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.judge.comparisons.chat import ChatComparison
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.agent.judge import Cost
from wm_nodes.judge.agent.profiles import uniform
from wm_nodes.judge.agent.types import ClipRef
from wm_nodes.judge.backends.prompts import data_uri
from wm_nodes.judge.backends.schemas import AnswerError, strip_reasoning

VIDEO_FPS = 2.0
CATEGORY = "robot"
SYSTEM = "You answer questions about a video by what is to be seen in it. Answer with yes or no, and with nothing else."
QUALITY = (
    "i2v_background", "i2v_subject", "aesthetic_quality", "imaging_quality", "background_consistency",
    "motion_smoothness", "subject_consistency", "overall_consistency",
)
"""The eight metrics, in the order of Table 1."""


@dataclass(frozen=True)
class BenchQuestion:
    """One yes-or-no question. task: what it is about, in the benchmark's own words (space, time, physics, ...)."""

    uid: str
    video_id: str
    text: str
    answer: Literal["yes", "no"]
    task: str


@dataclass(frozen=True)
class AnsweredQuestion:
    """said: None where the judge gave no usable answer, says `reason`; such a question is counted as not answered."""

    question: BenchQuestion
    said: Literal["yes", "no"] | None
    reason: str = ""
    cost: Cost = field(default_factory=Cost)

    @property
    def right(self) -> bool:
        return self.said == self.question.answer


def load_questions(folder: Path) -> list[BenchQuestion]:
    """Read the question files `robot_*.json` of the published data set.

    Raises:
        ValueError: no such file, or one that is not of this form; names it.
    """
    files = sorted(folder.glob(f"{CATEGORY}_*.json"))
    if not files:
        raise ValueError(f"{folder} has no {CATEGORY}_*.json; give the vqa folder of physical-ai-bench-predict")
    return [question for path in files for question in _questions(path)]


def _questions(path: Path) -> list[BenchQuestion]:
    try:
        return [_question(path.stem, entry) for entry in json.loads(path.read_bytes())]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no list of yes-or-no questions: {type(error).__name__}: {error}") from None


def _question(video_id: str, entry: Mapping[str, Any]) -> BenchQuestion:
    word = str(entry["index2ans"][entry["answer"]]).strip().lower()
    if word not in ("yes", "no"):
        raise ValueError(f"question {entry['uid']} expects {word!r}, neither yes nor no")
    answer: Literal["yes", "no"] = "yes" if word == "yes" else "no"
    return BenchQuestion(str(entry["uid"]), video_id, str(entry["question"]), answer, str(entry["task"]))


async def answer(judge: ChatComparison, question: BenchQuestion, clip: ClipRef) -> AnsweredQuestion:
    """Ask one question about one video."""
    shown = uniform(len(clip.frames), max(2, math.ceil(clip.duration_s * VIDEO_FPS)))
    content: list[dict[str, Any]] = []
    for index in shown:
        content.append({"type": "text", "text": f"frame at {index / clip.fps:.2f} s"})
        content.append({"type": "image_url", "image_url": {"url": data_uri(clip.frames[index])}})
    content.append({"type": "text", "text": f"{question.text}\nAnswer with yes or no."})
    said, reason, cost = await judge.ask(content, yes_or_no, len(shown), SYSTEM)
    return AnsweredQuestion(question, said, reason, cost)


def yes_or_no(text: str) -> Literal["yes", "no"]:
    """The one of the two words that an answer holds. Raises AnswerError: neither or both."""
    words = set(re.findall(r"[a-z]+", strip_reasoning(text).lower())) & {"yes", "no"}
    if len(words) != 1:
        raise AnswerError(f"the answer must hold either yes or no, got {text[:80]!r}")
    return "yes" if "yes" in words else "no"


def domain_score(answers: Sequence[AnsweredQuestion]) -> tuple[float, int]:
    """Accuracy in percent over the questions that were answered, and how many were not.

    Raises:
        ValueError: not one was answered.
    """
    said = [answer for answer in answers if answer.said is not None]
    if not said:
        reason = answers[0].reason if answers else "there are no questions"
        raise ValueError(f"no question was answered: {reason}")
    return 100 * sum(answer.right for answer in said) / len(said), len(answers) - len(said)


def consistency(features_TD: FloatArray) -> float:
    """Subject (DINO features) or background (CLIP features) consistency of VBench, in [-1, 1]:
    1 / (T - 1) sum_t 1/2 (cos(f_1, f_t) + cos(f_{t-1}, f_t)), t = 2..T.

    Raises:
        ValueError: fewer than two frames, or features that are zero or not finite.
    """
    norms = np.linalg.norm(features_TD, axis=1, keepdims=True)
    if features_TD.ndim != 2 or not np.isfinite(norms).all() or not (norms > 0).all():
        raise ValueError(f"features must be (T, D), finite and not zero, got shape {features_TD.shape}")
    if len(features_TD) < 2:
        raise ValueError(f"consistency needs at least 2 frames, got {len(features_TD)}")
    unit = features_TD / norms
    return float(((unit[1:] @ unit[0]) + (unit[1:] * unit[:-1]).sum(1)).mean() / 2)


def image_consistency(features_TD: FloatArray, image_D: FloatArray) -> float:
    """The image-to-video terms, our choice: `consistency` with the conditioning image as the frame before the first."""
    return consistency(np.concatenate([image_D[None], features_TD]))


def summary(domain: float, quality: Mapping[str, float]) -> dict[str, float]:
    """Domain, Quality and Overall, percent.

    Raises:
        ValueError: one of the eight metrics is missing or unknown; nothing is averaged over fewer.
    """
    if set(quality) != set(QUALITY):
        missing, foreign = sorted(set(QUALITY) - set(quality)), sorted(set(quality) - set(QUALITY))
        raise ValueError(f"Quality is the mean of eight metrics; missing: {missing}, unknown: {foreign}")
    mean = sum(quality.values()) / len(QUALITY)
    return {"domain": domain, "quality": mean, "overall": (domain + mean) / 2}
