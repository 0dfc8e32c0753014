"""Rewards of other papers through a chat server: what is asked, what is read, what is refused."""

import asyncio
import json
import math
from collections import deque
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chat_server import ChatServer, Fault
from numpy.testing import assert_allclose
from toy_set import write_toy_set

from benchmarks.judge.compared import ComparedAnswer, answer_file, compared, hacked_pairs
from benchmarks.judge.comparisons import pai_bench as pai
from benchmarks.judge.comparisons.chat import ChatComparison
from benchmarks.judge.comparisons.protocols import PAIRWISE, POINTWISE, read_flex, read_unified
from benchmarks.judge.line_file import LineFile
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.backends.schemas import AnswerError
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint, RetryPolicy
from wm_nodes.judge.dataset.rows import select_rows

FRAMES = np.random.default_rng(0).integers(0, 256, (20, 24, 32, 3), np.uint8)
CLIP, OTHER = clip_ref("one", FRAMES, 8.0), clip_ref("two", FRAMES[::-1].copy(), 8.0)
TASK = TaskSpec("push the red cube", "push", "panda", FRAMES[0])
UNIFIED = (
    "visual quality: 4\ntemporal consistency: 3\n**dynamic degree**: 2\ntext-to-video alignment: 1\n"
    "factual consistency: 3\nFinal Score: 7"
)


def reply(text: str) -> Fault:
    return Fault("reply", text=text)


def flex(*points: tuple[float, float], winner: str = "Video 1") -> str:
    dims = [{"name": f"d{i}", "reason_1": "a", "reason_2": "b", "score_1": a, "score_2": b} for i, (a, b) in
            enumerate(points)]
    categories = [{"name": name, "dims": [dim], "cat_winner": winner} for name, dim in zip("ABC", dims)]
    return json.dumps({"categories": categories, "reason": "so", "winner": winner})


def asked(steps: Callable[[ChatComparison], Awaitable[Any]], *replies: Fault) -> tuple[Any, list[dict[str, Any]]]:
    async def run() -> tuple[Any, list[dict[str, Any]]]:
        async with ChatServer(faults=deque(replies)).running() as server:
            transport = ChatTransport([Endpoint(server.url, "judge")], retry=RetryPolicy(2, 0.01, 0.02))
            try:
                return await steps(ChatComparison(transport)), server.requests
            finally:
                await transport.close()

    return asyncio.run(run())


def num_images(request: dict[str, Any]) -> int:
    return sum(part["type"] == "image_url" for part in request["messages"][-1]["content"])


@pytest.mark.parametrize(
    ("name", "text", "value", "images"),
    [
        ("videoalign", '{"VQ": 9, "MQ": 6, "TA": 3}', 0.6, 5),  # 20 frames at 8 per second are 2.5 s: 5 at 2 per second
        ("videoalign", '```json\n{"VQ": 10, "MQ": 10, "TA": 10}\n```', 1.0, 5),
        ("unifiedreward", UNIFIED, 6 / 9, 8),
        ("single", '<think>well</think>{"score": 2.5}', 0.25, 8),
    ],
)
def test_a_score_is_read_by_its_protocol(name: str, text: str, value: float, images: int) -> None:
    found, (request,) = asked(lambda judge: judge.score(POINTWISE[name], CLIP, TASK), reply(text))
    assert found.valid and found.value == pytest.approx(value) and found.cost.calls == 1
    assert num_images(request) == images == found.cost.images and request["temperature"] == 0
    assert TASK.instruction in json.dumps(request["messages"])


def test_an_answer_that_is_refused_is_asked_again_with_the_reason_and_then_given_up() -> None:
    bad = reply('{"VQ": 11, "MQ": 6, "TA": 3}')
    good = reply('{"VQ": 1, "MQ": 1, "TA": 1}')
    found, requests = asked(lambda judge: judge.score(POINTWISE["videoalign"], CLIP, TASK), bad, good)
    assert found.valid and found.value == pytest.approx(0.1) and found.cost.calls == 2
    assert "was refused: VQ: Input should be less than or equal to 10" in json.dumps(requests[1]["messages"])
    lost, _ = asked(lambda judge: judge.score(POINTWISE["videoalign"], CLIP, TASK), bad, reply("fine"))
    assert not lost.valid and math.isnan(lost.value) and "2 answers were refused" in lost.reason
    lengths = [Fault("length", text='{"score": 9}')] * 2
    cut, _ = asked(lambda judge: judge.score(POINTWISE["single"], CLIP, TASK), *lengths)
    assert not cut.valid and "finish_reason is 'length'" in cut.reason
    down, _ = asked(lambda judge: judge.score(POINTWISE["single"], CLIP, TASK), *[Fault("status", 500)] * 2)
    assert not down.valid and math.isnan(down.value) and "HTTP 500" in down.reason and down.cost.calls == 0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (UNIFIED.replace("Final Score: 7", ""), "'Final Score' is there 0 times"),
        (UNIFIED.replace("dynamic degree**: 2", "dynamic degree**: 5"), "dynamic degree must be 1 to 4, got 5"),
        (f"{UNIFIED}\nFinal Score: 8", "'Final Score' is there 2 times"),
        (UNIFIED.replace(": 7", ": 1.2.3"), "'1.2.3' is no number"),
    ],
)
def test_lines_that_are_not_the_protocols_are_refused(text: str, complaint: str) -> None:
    with pytest.raises(AnswerError, match=complaint):
        read_unified(text)


def test_points_of_a_pair_must_sum_to_ten_and_name_the_winner() -> None:
    assert read_flex(flex((6, 4), (7, 3), (5, 5))) == (pytest.approx(0.6), {"A": 0.6, "B": 0.7, "C": 0.5})
    with pytest.raises(AnswerError, match="6 \\+ 5 is not 10"):
        read_flex(flex((6, 5), (7, 3), (5, 5)))
    with pytest.raises(AnswerError, match=r"winner is Video 2, the points say 0\.60"):
        read_flex(flex((6, 4), (7, 3), (5, 5), winner="Video 2"))
    with pytest.raises(AnswerError, match="categories"):
        read_flex(flex((6, 4)))


def test_a_pair_is_asked_in_both_orders_so_that_a_place_is_no_advantage() -> None:
    first_is_better = reply(flex((7, 3), (7, 3), (7, 3)))
    second_is_better = reply(flex((3, 7), (3, 7), (3, 7), winner="Video 2"))
    protocol = PAIRWISE["unifiedreward-flex"]

    def compare(judge: ChatComparison) -> Awaitable[Any]:
        return judge.compare(protocol, CLIP, OTHER, TASK)

    fair, requests = asked(compare, first_is_better, second_is_better)
    assert fair.valid and fair.value == pytest.approx(0.7) and fair.consistent and fair.cost.calls == 2
    assert num_images(requests[0]) == 16 and "video 2, frame 0" in json.dumps(requests[0]["messages"])
    biased, _ = asked(compare, first_is_better, first_is_better)
    assert biased.value == pytest.approx(0.5) and not biased.consistent
    lost, _ = asked(compare, first_is_better, reply("no"), reply("no"))
    assert not lost.valid and math.isnan(lost.value)


# PAI-Bench


def test_the_papers_overall_is_the_mean_of_domain_and_of_eight_metrics() -> None:
    """Table 1 of the paper: two of its rows, to the digits that are printed."""
    rows = {
        (79.42, 83.61): (93.47, 91.13, 47.74, 70.45, 90.86, 98.80, 90.06, 19.30),
        (81.88, 86.95): (97.17, 96.05, 46.94, 71.32, 92.95, 99.25, 91.11, 19.68),
    }
    for (overall, domain), values in rows.items():
        assert pai.summary(domain, dict(zip(pai.QUALITY, values)))["overall"] == pytest.approx(overall, abs=0.006)
    with pytest.raises(ValueError, match=r"missing: \['aesthetic_quality'"):
        pai.summary(80.0, {"i2v_background": 90.0})


def test_consistency_is_the_mean_cosine_to_the_first_and_to_the_last_frame() -> None:
    """Three directions: 0, 90 and 0 degrees. cos to the first: 0, 1; to the one before: 0, 0; mean of halves: 1/4."""
    features = np.array([[1, 0], [0, 2], [3, 0]], np.float32)
    assert_allclose(pai.consistency(features), 0.25)
    assert_allclose(pai.consistency(np.ones((4, 3), np.float32)), 1.0, rtol=1e-6)
    assert_allclose(pai.image_consistency(features[1:], features[0]), 0.25)
    with pytest.raises(ValueError, match="at least 2 frames"):
        pai.consistency(features[:1])
    with pytest.raises(ValueError, match="not zero"):
        pai.consistency(np.zeros((3, 2), np.float32))


def question(folder: Path, name: str, answer: str = "A", **more: Any) -> None:
    entry = {"uid": f"{name}-0", "question": "Is the cube moved?", "answer": answer, "task": "space",
             "index2ans": {"A": "Yes", "B": "No"}} | more
    (folder / f"{name}.json").write_text(json.dumps([entry]))


def test_domain_questions_are_read_asked_and_counted(tmp_path: Path) -> None:
    question(tmp_path, "robot_1")
    question(tmp_path, "robot_2", "B")
    question(tmp_path, "av_1")
    one, two = pai.load_questions(tmp_path)
    assert (one.video_id, one.answer, two.answer) == ("robot_1", "yes", "no")

    async def steps(judge: ChatComparison) -> list[pai.AnsweredQuestion]:
        return [await pai.answer(judge, asked_of, CLIP) for asked_of in (one, two, one)]

    answers, requests = asked(steps, reply("Yes."), reply("yes"), reply("yes and no"), reply("maybe"))
    assert [answer.said for answer in answers] == ["yes", "yes", None] and num_images(requests[0]) == 5
    assert pai.domain_score(answers) == (50.0, 1) and "either yes or no" in answers[2].reason
    with pytest.raises(ValueError, match="no question was answered"):
        pai.domain_score(answers[2:])


def test_question_files_of_another_form_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"has no robot_\*\.json"):
        pai.load_questions(tmp_path)
    question(tmp_path, "robot_1", index2ans={"A": "Left", "B": "Right"})
    with pytest.raises(ValueError, match=r"robot_1\.json is no list .*expects 'left'"):
        pai.load_questions(tmp_path)
    (tmp_path / "robot_1.json").write_text("[{}]")
    with pytest.raises(ValueError, match="KeyError"):
        pai.load_questions(tmp_path)
    assert pai.yes_or_no("<think>no</think> Yes, it is.") == "yes"
    for text in ("nowhere", "no, yes", ""):
        with pytest.raises(AnswerError):
            pai.yes_or_no(text)


# over a set


def test_a_reward_is_compared_by_how_it_ranks_and_whether_hacked_clips_win(tmp_path: Path) -> None:
    """A server that scores every clip alike: AUROC is a half, and every hacked clip ties with its recording."""
    manifest = write_toy_set(tmp_path)
    rows = [row for row in select_rows(manifest, "test") if row.labels.pattern or not row.edits]
    pairs = hacked_pairs(rows)
    assert len(pairs) == 4 and all(row.labels.pattern and clean.labels.overall for row, clean in pairs)

    def file() -> LineFile[ComparedAnswer]:
        return answer_file(tmp_path / "judged", "single", "judge", 0)

    def over(count: int, name: str = "single") -> Any:
        kept = file() if name == "single" else answer_file(tmp_path / "judged", name, "judge", 0)
        replies = [reply('{"score": 5}') if name == "single" else reply(flex((8, 2), (8, 2), (8, 2)))] * count
        return asked(lambda judge: compared(judge, name, tmp_path, rows, kept), *replies)

    alike, requests = over(len(rows))
    assert len(requests) == len(rows) == alike.n and alike.invalid == 0 and alike.area == 0.5
    assert (alike.pairs, alike.win_rate, alike.calls, alike.images) == (4, 1.0, 1.0, 8.0) and alike.tokens > 0
    (path,) = (tmp_path / "judged").iterdir()
    path.write_bytes(path.read_bytes()[:-20])  # killed in the middle of the last line
    again, requests = over(1)
    assert len(requests) == 1 and again == alike and len(file().rows) == len(rows)
    first_place, _ = over(8, "unifiedreward-flex")  # whoever comes first is better: a tie once both orders are asked
    assert (first_place.pairs, first_place.win_rate, first_place.calls) == (4, 1.0, 2.0)
