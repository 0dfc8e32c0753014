"""A judge against public sets of recorded episodes in a local folder, through the reward agent's own service.

roboreward: metadata.jsonl beside the videos, a line each {"file_name": "SOURCE/NAME.mp4", "task": "...", "reward": 1 to
5}. Success is reward 5. The mean absolute error (MAE) is that of the score 1 + 4 R, as it is and rounded.
rt1: RT-1 is published as RLDS shards, and no layout of videos with failures could be established; so the folder holds
the videos and labels.csv. Clips without a reward are counted, never scored.
"""

import argparse
import csv
import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.experiment import Count, OnDevice
from wm_nodes.apps import options
from wm_nodes.config.load import load_config
from wm_nodes.core.files import text_lines
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.statistics import auroc, bootstrap_mean, wilson_of_share
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.clip_files import ClipLine, read_job
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.service import JudgeService

METADATA, TABLE, TEST, COLUMNS = "metadata.jsonl", "labels.csv", "test", {"file", "instruction", "label"}
TOP_SCORE, ROBOT, DRAWS = 5, "not told", 1000


@dataclass(kw_only=True)
class SuccessClips(OnDevice):
    """A judge against public sets of recorded episodes in a local folder, through the reward agent's own service.

    roboreward: FOLDER is the data set teetone/RoboReward (RoboRewardBench is its part test) or one of its parts, as it
    is published: metadata.jsonl beside the videos. rt1: episodes with a success label, the videos and labels.csv with
    the columns file, instruction, label (1 or 0). Nothing is downloaded.
    """

    folder: Path
    """Of the episodes."""
    format: Literal["roboreward", "rt1"]
    """Of the folder."""
    mode: Literal["reward", "topreward"] = "reward"
    """Of the judge."""
    clips: Count | None = None
    """The first so many; without, all."""
    reads: Path | None = None
    """Folder that keeps a server's answers."""
    seed: int = 0
    """Of the judge, and of the bootstrap."""

    @classmethod
    def add_settings(cls, parser: argparse.ArgumentParser) -> None:
        options.add_judge(parser)

    @classmethod
    def settings_of(cls, arguments: argparse.Namespace) -> dict[str, Any]:
        return options.judge_settings(arguments)

    def run(self) -> None:
        """Judge the clips, print the numbers and write --json."""
        config = load_config("cpu", {**self.settings, "device": self.device, "judge.mode": self.mode})
        folder, videos = FORMATS[self.format](self.folder)
        videos = videos[: self.clips]
        rows, size = list[Verdict](), config.judge.concurrency
        judge = JudgeService(config.judge, seed=self.seed, reads=self.reads, device=config.device)
        with closing(judge), tqdm(total=len(videos), desc="judged", unit="clip") as bar:
            for part in (videos[start : start + size] for start in range(0, len(videos), size)):
                lines = [ClipLine(file=video.file, instruction=video.instruction, robot=ROBOT) for video in part]
                rows += judge.judge([read_job(folder, line) for line in lines])
                bar.update(len(part))
        results = _results(videos, rows, self.seed)
        for name in ("clips", "statuses", "decided", "accuracy", "f1", "auroc", "mae", "mae_rounded"):
            if name in results:
                shown = results[name]
                form = "{:.3f} ({:.3f} to {:.3f})"
                print(f"{name:12} " + (form.format(*shown) if len(np.shape(shown)) else str(shown)))
        self.write({
            "experiment": "success-clips", "format": self.format, "judge": judge.judge_id, "mode": self.mode,
            "rubric": judge.version, "seed": self.seed, **results,
        })


class LabelledVideo(NamedTuple):
    """An episode with what people say of it."""

    file: str
    """Of the video, in the folder."""
    instruction: str
    """Of the task."""
    success: bool
    """Whether it was done."""
    score: int | None = None
    """1 to 5, None where only success is labelled."""


def read_roboreward(folder: Path) -> tuple[Path, list[LabelledVideo]]:
    """The folder of the videos, and their labels. Raises ValueError: no such list, or a bad line; names it."""
    folder = folder if (folder / METADATA).is_file() else folder / TEST
    videos = []
    for number, line in enumerate(_lines(folder / METADATA, "the data set teetone/RoboReward, or its folder test"), 1):
        try:
            row = json.loads(line)
            file, task, score = row["file_name"], row["task"], row["reward"]
            if not (isinstance(file, str) and isinstance(task, str) and score in range(1, TOP_SCORE + 1)):
                raise ValueError
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f"{folder / METADATA}:{number}: needs file_name, task and a reward of 1 to 5, got {line[:200]}"
            ) from None
        videos.append(LabelledVideo(file, task, score == TOP_SCORE, int(score)))
    return folder, videos


def read_table(folder: Path) -> tuple[Path, list[LabelledVideo]]:
    """As read_roboreward, of a table of success labels."""
    rows = csv.DictReader(_lines(folder / TABLE, "the videos of episodes and labels.csv (file, instruction, label)"))
    if missing := COLUMNS - set(rows.fieldnames or ()):
        raise ValueError(f"{folder / TABLE} has no column {', '.join(sorted(missing))}; write file,instruction,label")
    videos = []
    for row in rows:
        if row["label"] not in ("0", "1") or not row["file"]:
            raise ValueError(f"{folder / TABLE}:{rows.line_num}: needs a file and the label 1 or 0, got {row}")
        videos.append(LabelledVideo(row["file"], row["instruction"], row["label"] == "1"))
    return folder, videos


def _lines(path: Path, what: str) -> list[str]:
    try:
        return [line for line in text_lines(path.read_bytes()) if line.strip()]
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path} is missing; the folder must hold {what}. Nothing is downloaded") from None


FORMATS = {"roboreward": read_roboreward, "rt1": read_table}


Answers = Sequence[bool | None]


def success_numbers(success: Sequence[bool], accepted: Answers, rewards: Sequence[float], seed: int) -> dict[str, Any]:
    """Accuracy and F1 over decided clips, AUROC over clips with a reward (else NaN); [value, low, high] of 95 %."""
    truth, said, paid = np.array(success, bool), np.array(accepted, bool), ~np.isnan(rewards)
    known = np.array([answer is not None for answer in accepted], bool)
    return {
        "decided": int(known.sum()),
        "accuracy": [*wilson_of_share((truth == said)[known])],
        "f1": _bootstrapped(f1, truth[known], said[known], seed),
        "auroc": _bootstrapped(auroc, truth[paid], np.array(rewards)[paid], seed),
    }


def f1(labels: ArrayLike, answers: ArrayLike) -> float:
    """2 TP / (2 TP + FP + FN) of the successes; NaN where there is none, neither labelled nor said."""
    truth, said = np.array(labels, bool), np.array(answers, bool)
    both = int(truth.sum() + said.sum())
    return 2 * int((truth & said).sum()) / both if both else float("nan")


def score_errors(scores: Sequence[int], rewards: Sequence[float], seed: int) -> dict[str, Any]:
    """MAE of 1 + 4 R over clips with a reward; [value, low, high] of 95 %."""
    pairs = [(score, 1 + (TOP_SCORE - 1) * r) for score, r in zip(scores, rewards, strict=True) if not np.isnan(r)]
    if not pairs:
        return {}
    truth, said = np.array(pairs).T
    errors = {"mae": np.abs(truth - said), "mae_rounded": np.abs(truth - said.round())}
    return {name: bootstrap_mean(error, seed=seed) for name, error in errors.items()}


def _bootstrapped(statistic: Callable[[Any, Any], float], one: Any, other: Any, seed: int) -> list[float]:
    rows = numpy_stream(seed, "success-clips", len(one)).integers(max(1, len(one)), size=(DRAWS, len(one)))
    drawn = [value for index in rows if not np.isnan(value := statistic(one[index], other[index]))]
    low, high = np.quantile(drawn, (0.025, 0.975)) if drawn else (np.nan, np.nan)
    return [statistic(one, other), float(low), float(high)]


def _results(videos: Sequence[LabelledVideo], rows: list[Verdict], seed: int) -> dict[str, Any]:
    rewards, accepted = [row.reward for row in rows], [accepts(row) for row in rows]
    results = {
        "clips": len(videos), "statuses": dict(Counter(str(row.status) for row in rows)),
        **success_numbers([video.success for video in videos], accepted, rewards, seed),
    }
    if all(video.score is not None for video in videos):
        results |= score_errors([video.score or 0 for video in videos], rewards, seed)
    results["rows"] = [
        {**video._asdict(), "reward": row.reward, "accepted": answer, "status": str(row.status), "reason": row.reason}
        for video, row, answer in zip(videos, rows, accepted)
    ]
    return results
