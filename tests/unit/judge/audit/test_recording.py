"""What an audited agent leaves behind, and that verdicts come out of it again, bit for bit."""

import asyncio
import math
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_logs import clips, judge_all
from chat_server import ChatServer, Fault
from scripted_judge import (
    BORDERLINE,
    CLEAN,
    FAIR,
    FLAWED,
    UNUSABLE,
    WRONG,
    FaultyJudge,
    ScriptedJudge,
    clean_table,
    make_clip,
    make_task,
)

from wm_nodes.config.load import load_config
from wm_nodes.judge.agent.judge import Cost, JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import Status, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.entries import plain, typed
from wm_nodes.judge.audit.log import FILE_NAME, AuditError, AuditLog, read_lines
from wm_nodes.judge.audit.reading import Record, read_record, verify
from wm_nodes.judge.audit.recording import AuditedAgent, write_exchange
from wm_nodes.judge.audit.replay import reaggregate, replay_evaluation
from wm_nodes.judge.backends.cache import VerdictCache
from wm_nodes.judge.backends.openai_client import OpenAIJudge
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint, RetryPolicy

RUBRIC = load_rubric("robot")
TABLES: dict[str, dict[str, Any]] = {
    "clean": {},
    "early exit": {"clarity": UNUSABLE},
    "votes": {"robot": [BORDERLINE, WRONG, CLEAN, CLEAN, WRONG], "planning": FAIR},
    "hacked": {"occlusion": UNUSABLE},
    "fair": {"objective": FLAWED, "planning": FAIR},
}


@pytest.mark.parametrize("case", list(TABLES))
@pytest.mark.parametrize("mode", ["reward", "benchmark"])
def test_a_verdict_comes_out_of_the_log_bit_equal(tmp_path: Path, case: str, mode: str) -> None:
    judge = ScriptedJudge(clean_table(RUBRIC, **TABLES[case]), second={"clarity": CLEAN, "robot": WRONG})
    verdicts = judge_all(tmp_path, judge, clips(3), mode=mode, seed=4)
    record = read_record(tmp_path)
    for verdict, evaluation in zip(verdicts, record.judged()):
        assert plain(evaluation.verdict) == plain(verdict)  # NaN itself equals nothing
        again = asyncio.run(replay_evaluation(record, evaluation))
        assert again.equal
        assert again.after is not None and again.after.audit_id == verdict.audit_id
    assert verify(tmp_path).problems == []


def test_a_line_with_a_field_that_is_no_longer_written_is_read() -> None:
    assert typed(Cost, {**plain(Cost(calls=2)), "usd": None}) == Cost(calls=2)


def test_patterns_of_refused_clips_are_in_the_log_and_replayed(tmp_path: Path) -> None:
    rubric = load_rubric("robot", {"voting": {"audit_share": 0.5}})
    judge = ScriptedJudge(clean_table(rubric, robot=UNUSABLE, occlusion=UNUSABLE))
    verdicts = judge_all(tmp_path, judge, clips(8), rubric=rubric)
    assert 0 < sum(bool(verdict.hack_flags) for verdict in verdicts) < len(verdicts)
    record = read_record(tmp_path)
    assert all(asyncio.run(replay_evaluation(record, evaluation)).equal for evaluation in record.judged())
    assert verify(tmp_path).problems == []


def test_writing_down_changes_no_verdict_and_equal_runs_have_equal_hashes(tmp_path: Path) -> None:
    table = clean_table(RUBRIC, **TABLES["votes"])
    bare = [asyncio.run(RewardAgent(ScriptedJudge(table), RUBRIC, seed=1).evaluate(*pair)) for pair in clips(3)]
    first = judge_all(tmp_path / "a", ScriptedJudge(table), clips(3), seed=1)
    judge_all(tmp_path / "b", ScriptedJudge(table), clips(3)[::-1], seed=1)
    judge_all(tmp_path / "c", ScriptedJudge(table), clips(3), seed=2)
    assert [verdict.audit_id for verdict in first] == [verdict.audit_id for verdict in bare]
    assert verify(tmp_path / "a").verdicts == verify(tmp_path / "b").verdicts
    assert verify(tmp_path / "a").verdicts != verify(tmp_path / "c").verdicts
    assert verify(tmp_path / "a").head != verify(tmp_path / "b").head


@pytest.mark.parametrize(
    "fault", ["unavailable", "crash", "error", "abstain", "nan", "sum", "short", "mass", "missing", "twice"]
)
def test_a_failing_judge_fails_in_the_replay_with_the_same_words(tmp_path: Path, fault: str) -> None:
    (verdict,) = judge_all(tmp_path, FaultyJudge(clean_table(RUBRIC), "robot", fault), clips(1))
    assert math.isnan(verdict.reward)
    record = read_record(tmp_path)
    (evaluation,) = record.judged()
    assert asyncio.run(replay_evaluation(record, evaluation)).equal
    assert verify(tmp_path).problems == []


def test_a_clip_that_ran_out_of_time_is_recorded_and_not_replayed(tmp_path: Path) -> None:
    class Slow(ScriptedJudge):
        async def read(self, request: ReadRequest) -> list[Read]:
            await asyncio.sleep(5)
            return []

    (verdict,) = judge_all(tmp_path, Slow(clean_table(RUBRIC)), clips(1), budget_s=0.05)
    record = read_record(tmp_path)
    (evaluation,) = record.judged()
    assert verdict.status is Status.ERROR
    assert asyncio.run(replay_evaluation(record, evaluation)).after is None


@pytest.mark.parametrize(
    "frames",
    [
        np.full((4, 8, 8, 3), np.nan, np.float32),
        np.zeros((1, 8, 8, 3), np.uint8),
        np.zeros((4, 8, 8), np.uint8),
        np.zeros((0, 8, 8, 3), np.uint8),
    ],
)
def test_a_malformed_clip_is_recorded_as_it_is(tmp_path: Path, frames: np.ndarray[Any, Any]) -> None:
    clip = clip_ref("bad", frames, 8.0)
    task = replace(make_task(make_clip()), instruction="push the cube")
    (verdict,) = judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC)), [(clip, task)])
    assert verdict.status is Status.ERROR
    record = read_record(tmp_path)
    (evaluation,) = record.judged()
    np.testing.assert_array_equal(record.clip(evaluation).frames, frames)
    assert asyncio.run(replay_evaluation(record, evaluation)).equal
    assert verify(tmp_path).problems == []


def test_every_read_stands_on_a_line_of_its_own_with_its_reason_and_its_frames(tmp_path: Path) -> None:
    (verdict,) = judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC)), clips(1), round_number=7)
    lines = list(read_lines(tmp_path))
    reads = [line.body["read"] for line in lines if line.kind == "read"]
    assert len(reads) == verdict.num_reads
    assert {read["evidence_text"] for read in reads} >= {"clarity looks so", "interaction looks so"}
    (clip,) = [line.body for line in lines if line.kind == "clip"]
    asks = [line.body for line in lines if line.kind == "ask"]
    assert all(item["index"] < len(clip["frames"]) for ask in asks for item in ask["media"])
    (evaluation,) = read_record(tmp_path).judged(7)
    assert read_record(tmp_path).judged(6) == []
    actions = replace(make_task(make_clip()), actions=np.array([[0.1, np.pi]] * 15, np.float32))
    judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC)), [(make_clip(), actions)])
    record = read_record(tmp_path)
    stored = record.task(record.judged()[-1]).actions
    assert stored is not None and actions.actions is not None
    np.testing.assert_array_equal(stored, actions.actions)
    assert record.rubric(evaluation).version == RUBRIC.version


def counted_again(record: Record, rubric: Rubric, folder: Path) -> Verdict:
    """The one verdict of a log under another rubric."""
    with AuditLog(folder) as log:
        (verdict,) = asyncio.run(reaggregate(record, record.judged(), rubric, log))
    return verdict


def test_other_numbers_need_no_judge_and_other_words_do(tmp_path: Path) -> None:
    table = clean_table(RUBRIC, interaction=FLAWED)
    (verdict,) = judge_all(tmp_path, ScriptedJudge(table), clips(1), mode="benchmark")
    record = read_record(tmp_path)
    stricter = load_rubric("robot", {"revision": 2, "stages": {"PC": {"threshold": 0.95}}})
    after = counted_again(record, stricter, tmp_path / "stricter")
    assert after.provenance.rubric_version == stricter.version
    assert verdict.stages[3].passed and not after.stages[3].passed
    direct = asyncio.run(RewardAgent(ScriptedJudge(table), stricter, mode="benchmark").evaluate(*clips(1)[0]))
    assert after.audit_id == direct.audit_id
    words = load_rubric("robot", {"stages": {"PC": {"components": {"interaction": {"question": "Does it touch?"}}}}})
    with pytest.raises(AuditError, match="asks about interaction in other words"):
        counted_again(record, words, tmp_path / "words")


def test_a_question_that_nobody_asked_is_an_error_that_names_it(tmp_path: Path) -> None:
    (verdict,) = judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC, clarity=(0.0, 0.75, 0.25, 0.0, 0.0))), clips(1))
    assert verdict.status is Status.OK and verdict.stages[1].status is Status.SKIPPED
    record = read_record(tmp_path)
    lenient = load_rubric("robot", {"stages": {"VQ": {"threshold": 0.1}}, "voting": {"veto": 1.0}})
    after = counted_again(record, lenient, tmp_path / "lenient")
    assert after.status is Status.ERROR and math.isnan(after.reward)
    assert "the log has no answer on background, vote 0" in after.reason


def test_every_clip_is_counted_again_by_what_was_said_of_it_then(tmp_path: Path) -> None:
    """The same clip with two instructions, and with one of them again, after the judge did not answer."""

    class Listening(ScriptedJudge):
        """Sees an undone task where a green cube is named, and does not answer the first question."""

        async def read(self, request: ReadRequest) -> list[Read]:
            if not self.requests:
                self.requests.append(request)
                raise JudgeError("connection refused")
            self.table = clean_table(RUBRIC, task_completion=WRONG if "green" in request.task.instruction else CLEAN)
            return await super().read(request)

    clip = make_clip()
    red = make_task(clip)
    jobs = [(clip, red), (clip, red), (clip, replace(red, instruction="push the green cube to the mark"))]
    before = judge_all(tmp_path / "log", Listening(clean_table(RUBRIC)), jobs, mode="benchmark")
    assert [verdict.valid for verdict in before] == [False, True, True] and before[1].reward > before[2].reward
    record, rubric = read_record(tmp_path / "log"), load_rubric("robot", {"revision": 2})
    with AuditLog(tmp_path / "again") as log:
        after = asyncio.run(reaggregate(record, record.judged(), rubric, log))
    np.testing.assert_array_equal([v.reward for v in after], [v.reward for v in before])
    assert [v.reason for v in after] == [v.reason for v in before]


def test_verify_names_a_picture_that_was_changed_and_a_cut_end(tmp_path: Path) -> None:
    judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC)), clips(1))
    checked = verify(tmp_path)
    picture = next((tmp_path / "media").rglob("*.png"))
    whole = picture.read_bytes()
    picture.write_bytes(whole[:-1])
    assert any("was changed after it was stored" in problem for problem in verify(tmp_path).problems)
    assert verify(tmp_path, pictures=False).problems == []
    picture.write_bytes(whole)
    lines = (tmp_path / FILE_NAME).read_bytes().splitlines(keepends=True)
    (tmp_path / FILE_NAME).write_bytes(b"".join(lines[:-1]))
    assert verify(tmp_path).problems == []  # a chain cannot see that its end is missing
    assert verify(tmp_path).unfinished == 1
    (problem,) = verify(tmp_path, expected_head=checked.head).problems
    assert "cut off" in problem


def test_prompts_and_raw_replies_of_a_server_are_kept_and_its_key_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JUDGE_API_KEY", "a-key-of-the-server")

    settings = load_config("cpu", {"judge.repeat_share": 0.0}).judge

    async def run(server: ChatServer, folder: Path, cache: VerdictCache) -> Verdict:
        async with server.running():
            transport = ChatTransport([Endpoint(server.url, "judge", "JUDGE_API_KEY")], retry=RetryPolicy(2, 0, 0))
            with AuditLog(folder) as log:
                judge = OpenAIJudge(transport, RUBRIC, settings, cache, partial(write_exchange, log))
                verdict = await AuditedAgent(judge, RUBRIC, log, call_plan="pack").evaluate(*clips(1)[0])
            await transport.close()
            return verdict

    faults = [Fault("reply", text="key a-key-of-the-server is fine"), Fault("status", 500, "no a-key-of-the-server")]
    verdict = asyncio.run(run(ChatServer(faults=deque(faults)), tmp_path / "a", VerdictCache(tmp_path / "cache")))
    text = (tmp_path / "a" / FILE_NAME).read_text()
    assert "a-key-of-the-server" not in text and "key [JUDGE_API_KEY] is fine" in text
    record = read_record(tmp_path / "a")
    (evaluation,) = record.judged()
    first, second = evaluation.exchanges[:2]
    assert first["reply"]["choices"][0]["message"]["content"].startswith("key [JUDGE_API_KEY]")
    assert "How good is this clip as a whole" in "\n".join(first["prompt"])
    assert "Your last answer was refused" in second["prompt"][-1]
    assert second["settings"]["temperature"] == 0
    assert all("base64" not in "".join(exchange["prompt"]) for exchange in evaluation.exchanges)
    assert asyncio.run(replay_evaluation(record, evaluation)).equal
    assert verify(tmp_path / "a").problems == []
    again = asyncio.run(run(ChatServer(), tmp_path / "b", VerdictCache(tmp_path / "cache")))
    assert again.audit_id == verdict.audit_id
    (cached,) = read_record(tmp_path / "b").judged()
    assert all(exchange["cached"] for exchange in cached.exchanges)


def test_a_secret_in_a_reason_is_replaced_and_the_verdict_still_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JUDGE_API_KEY", "robot looks so")  # the scripted judge says this of the robot
    (verdict,) = judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC, planning=FAIR)), clips(1))
    assert "robot looks so" not in (tmp_path / FILE_NAME).read_text()
    record = read_record(tmp_path)
    (evaluation,) = record.judged()
    assert evaluation.redacted
    assert evaluation.verdict.audit_id == verdict.audit_id
    assert asyncio.run(replay_evaluation(record, evaluation)).equal
    assert verify(tmp_path).problems == []
    monkeypatch.delenv("JUDGE_API_KEY")
    judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC)), clips(1))
    assert not read_record(tmp_path).judged()[-1].redacted


def test_verify_names_a_verdict_that_is_not_what_its_id_says(tmp_path: Path) -> None:
    (verdict,) = judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC)), clips(1))
    number = read_record(tmp_path).judged()[0].number
    with AuditLog(tmp_path) as log:  # whoever can write can add a line that fits the chain
        log.append("verdict", {"evaluation": number, "verdict": plain(replace(verdict, reward=0.99))})
    (problem,) = verify(tmp_path).problems
    assert problem == f"evaluation {number} of clip 'clip0': its verdict is not what its audit id says"
