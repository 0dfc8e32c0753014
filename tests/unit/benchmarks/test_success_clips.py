"""Public success sets as a command: the published layouts in a local folder, a chat server, metrics worked by hand."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from chat_server import ChatServer, Fault
from judge_server import serving

from benchmarks.judge.success_clips import (
    f1,
    read_roboreward,
    read_table,
    score_errors,
    success_numbers,
)
from wm_nodes.apps.cli import main

NAN = float("nan")
P_TRUE = {"a": 0.9, "b": 0.2, "c": 0.6, "d": 0.6}


class ByTask(ChatServer):
    """p(True) by the last word of the task; it grows with the frames shown."""

    def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
        content = body["messages"][1]["content"]
        shown = sum(part["type"] == "image_url" for part in content) / 16
        p = P_TRUE[content[-1]["text"].split("\n")[0][-1]] * min(1.0, 0.5 + shown)
        self.labels = {"True": p, "False": 1 - p}
        return super()._completion(body, fault)


def write_video(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (32, 32))
    for frame in np.random.default_rng(seed).integers(0, 256, (8, 32, 32, 3), np.uint8):
        writer.write(frame)
    writer.release()


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """Four videos of the published layout with the scores 5, 1, 3, 5, and one that is missing."""
    rows = [("droid/a.mp4", "a", 5), ("droid/b.mp4", "b", 1), ("arena/c.mp4", "c", 3), ("arena/d.mp4", "d", 5)]
    for seed, (file, _, _) in enumerate(rows):
        write_video(tmp_path / "test" / file, seed)
    rows.append(("droid/lost.mp4", "a", 5))
    lines = [
        json.dumps({"file_name": f, "task": f"reach {task}", "reward": score, "gpt5_mini_check": "ANSWER: 1"})
        for f, task, score in rows
    ]
    (tmp_path / "test" / "metadata.jsonl").write_text("\n".join(lines) + "\n")
    return tmp_path


def measured(folder: Path, *options: str) -> dict[str, Any]:
    with serving(ByTask()) as server:
        command = ["benchmark", "success-clips", "--folder", str(folder), "--mode", "topreward"]
        judge = ["--judge", server.url, "--judge-model", "judge"]
        assert not main([*command, *judge, "--json", str(folder / "found.json"), *options])
    return dict(json.loads((folder / "found.json").read_text()))


def test_roborewardbench_is_read_as_published_and_scored_by_mae(bench: Path) -> None:
    found = measured(bench, "--format", "roboreward")
    assert found["clips"] == 5 and found["statuses"] == {"OK": 4, "ERROR": 1} and found["decided"] == 4
    assert [row["reward"] for row in found["rows"]] == [0.9, 0.2, 0.6, 0.6, None]
    assert found["mae"][0] == pytest.approx((0.4 + 0.8 + 0.4 + 1.6) / 4)  # 1 + 4 R is 4.6, 1.8, 3.4, 3.4
    assert found["mae_rounded"][0] == pytest.approx((0 + 1 + 0 + 2) / 4)
    assert found["accuracy"][0] == pytest.approx(3 / 4) and found["f1"][0] == pytest.approx(4 / 5)
    assert found["auroc"][0] == pytest.approx(3.5 / 4)
    assert all(low <= value <= high for value, low, high in (found[n] for n in ("mae", "accuracy", "f1", "auroc")))
    assert found["mode"] == "topreward" and found["rubric"].startswith("topreward-1-")
    assert measured(bench / "test", "--format", "roboreward", "--clips", "2")["clips"] == 2


def test_a_table_of_success_labels_is_read_and_has_no_score(bench: Path) -> None:
    (bench / "test" / "labels.csv").write_text("file,instruction,label\ndroid/a.mp4,reach a,1\ndroid/b.mp4,reach b,0\n")
    found = measured(bench / "test", "--format", "rt1")
    assert found["accuracy"][0] == 1 and found["auroc"][0] == 1 and "mae" not in found


def test_nothing_is_claimed_where_nothing_was_decided() -> None:
    found = success_numbers([True, False], [None, None], [NAN, NAN], 0)
    assert found["decided"] == 0 and found["accuracy"][1:] == [0, 1] and np.isnan(found["accuracy"][0])
    assert np.isnan(found["f1"][0]) and np.isnan(found["auroc"]).all()
    assert score_errors([5, 1], [NAN, NAN], 0) == {}
    assert f1([True, True, False, False], [True, False, True, False]) == 0.5


@pytest.mark.parametrize(
    ("read", "file", "text", "problem"),
    [
        (read_roboreward, "metadata.jsonl", None, "metadata.jsonl is missing; the folder must hold the data set"),
        (read_roboreward, "metadata.jsonl", '{"file_name": "a", "task": "b", "reward": 6}', "a reward of 1 to 5, got"),
        (read_roboreward, "metadata.jsonl", "no json", ":1: needs file_name, task and a reward"),
        (read_table, "labels.csv", None, "labels.csv is missing; the folder must hold the videos of episodes"),
        (read_table, "labels.csv", "file,label\na,1", "has no column instruction"),
        (read_table, "labels.csv", "file,instruction,label\na,b,perhaps", ":2: needs a file and the label 1 or 0"),
    ],
)
def test_a_list_that_is_missing_or_wrong_is_named_with_its_line_and_the_remedy(
    tmp_path: Path, read: Callable[[Path], Any], file: str, text: str | None, problem: str
) -> None:
    if text is not None:
        (tmp_path / file).write_text(text)
    with pytest.raises(ValueError, match=re.escape(problem)):
        read(tmp_path)
