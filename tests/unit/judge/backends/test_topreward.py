"""Mode topreward: the probability of "True" for "the task is completed", by a real HTTP server that answers on cue."""

import asyncio
import json
import math
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from chat_server import ChatServer, Fault
from clip_folders import write_clips
from judge_server import serving
from scripted_judge import make_clip, make_task

from wm_nodes.apps.cli import main
from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import load_config
from wm_nodes.judge.agent import topreward
from wm_nodes.judge.agent.types import GATED, Stage, Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.entries import plain
from wm_nodes.judge.audit.reading import read_record, verify
from wm_nodes.judge.audit.replay import replay_evaluation
from wm_nodes.judge.backends.calls import OWN_FIELDS
from wm_nodes.judge.backends.factory import check_judge
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.service import ClipJob, JudgeService

TRUE_OR_FALSE = {"True": 0.5, " True": 0.1, "False": 0.2, "The": 0.2}
"""p(True) is 0.6 of a label mass of 0.8."""


def settings(server: ChatServer, **changes: Any) -> JudgeConfig:
    values = {"endpoints": [server.url], "model": "judge", "tries": 1, "mode": "topreward", "repeat_share": 0.0}
    return JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **values, **changes})


def jobs(count: int, num_frames: int = 12) -> list[ClipJob]:
    return [ClipJob(clip, make_task(clip)) for clip in (make_clip(seed, num_frames) for seed in range(count))]


def judged(server: ChatServer, count: int = 1, **places: Any) -> list[Verdict]:
    changes = {name: places.pop(name) for name in ("choice_grammar", "extra_body", "label_token_ids") if name in places}
    with serving(server), closing(JudgeService(settings(server, **changes), seed=0, **places)) as judge:
        return judge.judge(jobs(count))


def test_the_reward_is_the_probability_of_true_of_one_token_and_nothing_else_is_read() -> None:
    server = ChatServer(labels=TRUE_OR_FALSE)
    (verdict,) = judged(server)
    assert verdict.status is Status.OK and verdict.reward == pytest.approx(0.6 / 0.8) and accepts(verdict) is True
    (stage,) = verdict.stages
    assert (stage.stage, stage.passed, [c.component for c in stage.components]) == (Stage.TC, True, ["task_completion"])
    assert (verdict.plan, verdict.level, verdict.num_reads, verdict.cost.calls) == (None, -1, 1, 1)
    (body,) = server.requests
    assert (body["max_tokens"], body["logprobs"], body["temperature"]) == (1, True, 0)
    *media, statement = body["messages"][1]["content"]
    assert sum(part["type"] == "image_url" for part in media) == 12
    task = make_task(make_clip(0)).instruction
    assert f"completes the following task: {task}\nDecide whether" in statement["text"]


def test_an_unlikely_success_keeps_its_number_and_is_not_accepted() -> None:
    (verdict,) = judged(ChatServer(labels={"True": 0.1, "False": 0.9}))
    assert (verdict.status, accepts(verdict)) == (Status.OK, False) and verdict.reward == pytest.approx(0.1)
    assert verdict.stages[0].passed, "it gates nothing"


@pytest.mark.parametrize(
    ("labels", "status", "reason"),
    [({"True": 0.3, "False": 0.1, "The": 0.6}, Status.ABSTAIN, "label mass 0.400 is below 0.5"),
     ({"A": 0.5, "true": 0.5}, Status.ABSTAIN, "label mass 0.000"),
     ({}, Status.ERROR, "gives no logprobs")],
)
@pytest.mark.parametrize("grammar", [False, True])
def test_a_model_that_says_something_else_gives_no_number_whatever_the_grammar(
    labels: dict[str, float], status: Status, reason: str, grammar: bool
) -> None:
    server = ChatServer(labels=labels or {"True": 1.0}, gives_logprobs=bool(labels))
    (verdict,) = judged(server, choice_grammar=grammar, label_token_ids=[1, 2, 3, 4, 5])
    assert (verdict.status, verdict.valid, accepts(verdict)) == (status, False, None)
    assert math.isnan(verdict.reward) and reason in verdict.reason
    assert not {"structured_outputs", "logprob_token_ids"} & server.requests[0].keys(), "those name letters"


def test_a_lost_server_is_an_error_without_a_number() -> None:
    server = ChatServer(labels=TRUE_OR_FALSE)
    server.faults.append(Fault("status", 500))
    (verdict,) = judged(server)
    assert verdict.status is Status.ERROR and math.isnan(verdict.reward) and "HTTP 500" in verdict.reason


def test_its_verdicts_are_told_from_the_staged_agents_come_out_of_the_log_and_are_bought_once(tmp_path: Path) -> None:
    server = ChatServer(labels=TRUE_OR_FALSE)
    first = judged(server, 3, audit=tmp_path / "audit", reads=tmp_path / "reads")
    assert {verdict.provenance.rubric_version for verdict in first} == {topreward.VERSION}
    record = read_record(tmp_path / "audit")
    for verdict, evaluation in zip(first, record.judged(), strict=True):
        assert plain(evaluation.verdict) == plain(verdict) and len(evaluation.asks) == 1
        assert asyncio.run(replay_evaluation(record, evaluation)).equal
    assert verify(tmp_path / "audit").problems == []
    again = judged(server, 3, reads=tmp_path / "reads")
    assert len(server.requests) == 3 and [v.audit_id for v in again] == [v.audit_id for v in first]
    staged = settings(server, mode="reward")
    with serving(ChatServer()) as other:
        with closing(JudgeService(staged.model_copy(update={"endpoints": [other.url]}), seed=0)) as judge:
            assert judge.version == judge.rubric.version != topreward.VERSION
            assert judge.judge(jobs(1))[0].provenance.rubric_version == judge.version


def test_the_frames_that_are_shown_lie_evenly_and_are_as_many_as_the_judge_takes() -> None:
    long = make_clip(0, 40)
    assert [item.index for item in topreward.shown_frames(long, 4)] == [0, 13, 26, 39]
    assert len(topreward.shown_frames(long, 64)) == topreward.NUM_FRAMES


@pytest.mark.parametrize(
    "changes", [{"kind": "embedded"}, {"routes": [{"stages": ["TC"], "endpoints": ["http://b/v1"], "model": "b"}]}],
)
def test_a_judge_that_has_no_probability_of_a_word_is_refused_before_anything_is_judged(
    changes: dict[str, Any],
) -> None:
    with pytest.raises(ValueError, match=r"judge\.mode topreward reads the probability of a word from one server"):
        check_judge(settings(ChatServer(url="http://a/v1"), **changes))


QUIET = "chat_template_kwargs={enable_thinking: false}"
FIELD = "--judge.extra_body."


@pytest.mark.parametrize("limit", ["max_tokens", "max_completion_tokens"])
def test_fields_of_the_command_line_go_with_every_kind_of_call_as_they_are_given(tmp_path: Path, limit: str) -> None:
    write_clips(tmp_path)
    fields = [QUIET, f"{limit}=77", "mm_processor_kwargs={fps: 2}", "media_io_kwargs={video: {num_frames: -1}}"]
    given = {"chat_template_kwargs": {"enable_thinking": False}, limit: 77, "mm_processor_kwargs": {"fps": 2},
             "media_io_kwargs": {"video": {"num_frames": -1}}}
    kinds = set()
    for mode, labels in (("benchmark", {"C": 0.9, "A": 0.1}), ("topreward", TRUE_OR_FALSE)):
        with serving(ChatServer(labels=labels, level=2)) as server:
            command = ["judge-clips", str(tmp_path), "--judge", server.url, "--judge-model", "judge", "--mode", mode]
            assert main([*command, *(FIELD + field for field in fields)]) in (0, 1)
        for body in server.requests:
            assert body.items() >= given.items() and (limit == "max_tokens" or "max_tokens" not in body)
            kinds.add("json" if "response_format" in body else "truth" if "Decide whether" in json.dumps(body) else "A")
    assert kinds == {"json", "A", "truth"}


@pytest.mark.parametrize("name", sorted(OWN_FIELDS))
def test_a_field_that_only_the_judge_may_set_is_refused_on_the_command_line(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clips(tmp_path)
    command = ["judge-clips", str(tmp_path), "--judge", "http://127.0.0.1:9/v1", "--judge-model", "m"]
    assert main([*command, f"{FIELD}{name}=1"]) == 2
    assert f"judge.extra_body sets {name}, which the judge sets itself" in capsys.readouterr().err
    assert main([*command, f"{FIELD}{name}"]) == 2


def test_its_message_has_every_stage_as_the_actions_count_them() -> None:
    pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")
    from wm_nodes.nodes.judge.verdict_message import verdict_msg

    (verdict,) = judged(ChatServer(labels=TRUE_OR_FALSE))
    message = verdict_msg(verdict)
    assert list(message.stages) == [*map(str, GATED)] and list(message.stage_passed) == [0, 0, 1, 0]
    skipped = (message.SKIPPED, message.SKIPPED, message.OK, message.SKIPPED)
    assert tuple(message.stage_status) == skipped and message.stage_scores[2] == pytest.approx(verdict.reward)
    assert math.isnan(message.stage_scores[0]) and list(message.stage_vetoed_by) == [""] * 4
    assert list(message.component_stages) == ["TC"]
