"""Clips in a folder, judged by an action over sockets: by a server, and by the embedded judge and nothing else."""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clip_folders import write_clips
from deadlines import within
from graph.harness import Graph, Probe, own_domain, wait_until
from judge_server import PickyServer
from safetensors.numpy import load_file

from wm_msgs.action import JudgeClips
from wm_msgs.msg import ClipVerdict, ErrorCode
from wm_msgs.srv import SetRubric
from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.judge.agent.types import clip_ref
from wm_nodes.judge.audit.reading import read_record
from wm_nodes.judge.clip_files import AT_ONCE, LIST, list_sha256

pytestmark = [pytest.mark.graph, pytest.mark.alone]

NODE = "/wm/reward_evaluator"
ANSWER_S = 1.0
"""A cancel is answered within this time."""


class Evaluator:
    """A reward evaluator alone in its graph, its run folder, and the verdicts that it publishes."""

    def __init__(self, domain: int, folder: Path, allowed: Path, **judge: Any) -> None:
        self.folder, self.probe = folder, Probe(domain)
        self._graph = Graph(domain, folder, load_config("smoke", judge))
        self.verdicts: list[ClipVerdict] = self.probe.listen("reward/verdict")
        self._graph.start("reward_evaluator", reward="agent", audit_dir="audit", allowed_dirs=[str(allowed)])
        wait_until("the evaluator", lambda: self.probe.value(NODE, "state") == "active")
        self._client = self.probe.action(JudgeClips, "reward/judge_clips")

    def close(self) -> None:
        self.probe.close()
        assert set(self._graph.stop().values()) == {0}

    def goal(self, **goal: Any) -> Any:
        """A goal's handle."""
        return self.probe.send(self._client, JudgeClips.Goal(**goal))

    def judge(self, **goal: Any) -> JudgeClips.Result:
        return self.probe.finish(self.goal(**goal))


@pytest.fixture(scope="module")
def running(server: PickyServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Evaluator]:
    judge = {"judge.endpoints": [server.url], "judge.model": "judge", "judge.tries": 1, "judge.keep_reads": False}
    with own_domain() as domain:
        allowed = tmp_path_factory.getbasetemp()
        evaluator = Evaluator(domain, tmp_path_factory.mktemp("folder") / "run", allowed, **judge)
        try:
            yield evaluator
        finally:
            evaluator.close()


@pytest.fixture
def evaluator(running: Evaluator, server: PickyServer) -> Iterator[Evaluator]:
    running.verdicts.clear()
    yield running
    server.down, server.delay_s = False, 0.0


def test_a_folder_is_judged_in_its_order_published_and_audited(evaluator: Evaluator, tmp_path: Path) -> None:
    write_clips(tmp_path)
    told = evaluator.probe.feedback(JudgeClips, "reward/judge_clips")
    result = evaluator.judge(folder=str(tmp_path))
    assert (result.termination_reason, result.message) == (JudgeClips.Result.FINISHED, "")
    assert result.pause_reason == "" and [verdict.clip_id for verdict in result.verdicts] == ["a", "mine"]
    sha256 = list_sha256(tmp_path)
    for row, verdict in enumerate(result.verdicts):
        assert (verdict.status, verdict.clip, verdict.buffer_sha256) == (ClipVerdict.OK, row, sha256)
        assert 0 < verdict.reward <= 1 and verdict.judge_id
    assert result.verdicts[1].media_sha == clip_ref("mine", np.load(tmp_path / "b.npy"), 10.0).sha256
    wait_until("published verdicts", lambda: len(evaluator.verdicts) == 2)
    assert {v.audit_id for v in evaluator.verdicts} == {v.audit_id for v in result.verdicts}
    wait_until("feedback", lambda: told[-1:] and told[-1].progress == 1.0)
    assert (told[-1].clips_done, told[-1].clips_invalid) == (2, 0)
    assert told[-1].calls == sum(verdict.calls for verdict in result.verdicts) > 0
    audited = [entry.verdict.audit_id for entry in read_record(evaluator.folder / "audit").judged() if entry.verdict]
    assert sorted(audited[-2:]) == sorted(verdict.audit_id for verdict in result.verdicts), "written as they end"


def test_a_folder_may_be_named_from_the_run_folder_and_a_longer_list_than_is_held_at_once_keeps_its_order(
    evaluator: Evaluator,
) -> None:
    folder = evaluator.folder / "own clips"
    folder.mkdir()
    np.save(folder / "small.npy", np.random.default_rng(0).integers(0, 256, (3, 16, 16, 3), np.uint8))
    lines = [{"file": "small.npy", "instruction": "push", "clip_id": f"clip {n}"} for n in range(AT_ONCE + 1)]
    (folder / LIST).write_text("".join(json.dumps(line) + "\n" for line in lines))
    result = evaluator.judge(folder="own clips", sha256=list_sha256(folder))
    assert (result.termination_reason, result.message) == (JudgeClips.Result.FINISHED, "")
    assert [(v.clip, v.clip_id) for v in result.verdicts] == [(n, f"clip {n}") for n in range(AT_ONCE + 1)]


@pytest.mark.parametrize(
    ("changed", "goal", "said"),
    [
        ({}, {"folder": "nowhere"}, "nowhere/clips.jsonl is missing: one line per clip"),
        ({}, {"sha256": "0" * 64}, "is not the announced list"),
        ({}, {"deadline_s": float("nan")}, "deadline_s must be 0 (no limit) or a number of seconds, got nan"),
        ({}, {"deadline_s": -1.0}, "a number of seconds, got -1"),
        ({"speed": 3}, {}, "clips.jsonl:2: speed: Extra inputs"),
        ({}, {"folder": "/dev"}, "'/dev' lies outside of the run folder and of allowed_dirs"),
        ({}, {"folder": "~"}, "'~' is no name of a file"),
    ],
    ids=["no_folder", "another_list", "no_time", "past", "unknown_field", "outside", "home"],
)
def test_a_folder_that_cannot_be_read_ends_the_goal_with_what_is_wrong(
    evaluator: Evaluator, tmp_path: Path, changed: dict[str, Any], goal: dict[str, Any], said: str
) -> None:
    write_clips(tmp_path, **changed)
    result = evaluator.judge(**{"folder": str(tmp_path), **goal})
    assert result.termination_reason == JudgeClips.Result.FAILED and said in result.message
    assert not result.verdicts and not evaluator.verdicts


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"file": "gone.mp4", "sha256": ""}, "gone.mp4 is no readable video"),
        ({"sha256": "0" * 64}, "has content"),
        ({"file": "/etc/passwd", "sha256": ""}, "'/etc/passwd' lies outside of the run folder and of allowed_dirs"),
        ({"goal": "/etc/no_such.png"}, "'/etc/no_such.png' lies outside of the run folder and of allowed_dirs"),
        ({"reference": "zero"}, "zero' is no regular file; name a file that holds a picture"),
        ({"file": "link.npy", "sha256": ""}, "link.npy' lies outside of the run folder and of allowed_dirs"),
    ],
    ids=["no_file", "another_clip", "outside_file", "outside_picture", "no_file_but_a_pipe", "link_outside"],
)
def test_a_clip_that_cannot_or_may_not_be_read_is_named_and_the_others_are_judged(
    evaluator: Evaluator, tmp_path: Path, changed: dict[str, Any], said: str
) -> None:
    write_clips(tmp_path, **changed)
    os.mkfifo(tmp_path / "zero")
    (tmp_path / "link.npy").symlink_to("/dev/zero")
    result = evaluator.judge(folder=str(tmp_path))
    assert (result.termination_reason, result.message) == (JudgeClips.Result.FINISHED, "")
    good, bad = result.verdicts
    assert good.status == ClipVerdict.OK and 0 < good.reward <= 1
    assert bad.status == ClipVerdict.ERROR and np.isnan(bad.reward) and said in bad.reason and not bad.calls


@pytest.mark.parametrize(
    ("pack", "words"),
    [
        ("/etc/strict.yaml", "'/etc/strict.yaml' lies outside of the run folder and of allowed_dirs"),
        ("link.yaml", "'link.yaml' lies outside"),
        ("extends.yaml", "'/etc/strict.yaml' lies outside"),
        ("pipe.yaml", "'pipe.yaml' is no regular file; name a file that holds a rubric pack"),
        ("large.yaml", "'large.yaml' is larger than the 1 MiB a rubric pack may have"),
        ("latin.yaml", "refused"),
        ("deep.yaml", "refused"),
        ("x" * 300 + ".yaml", "is no name of a file"),
    ],
    ids=["outside", "link_outside", "extends_outside", "pipe", "large", "no_utf8", "deep", "long"],
)
def test_a_rubric_that_nobody_may_name_leaves_the_one_before_and_is_counted(
    evaluator: Evaluator, pack: str, words: str
) -> None:
    folder, before = evaluator.folder, int(evaluator.probe.value(NODE, "refused_rubrics") or 0)
    if not (folder / "pipe.yaml").exists():
        os.mkfifo(folder / "pipe.yaml")
        (folder / "link.yaml").symlink_to("/etc/passwd")
        (folder / "extends.yaml").write_text("extends: /etc/strict.yaml\n")
        (folder / "large.yaml").write_bytes(b"#" * (1 << 20) + b"\n")
        (folder / "latin.yaml").write_bytes(b"name: \xff\xfe\xe9\n")
        (folder / "deep.yaml").write_text("[" * 5000)
    answer = evaluator.probe.call(SetRubric, "reward/set_rubric", SetRubric.Request(pack=pack))
    assert answer.error_code == ErrorCode.OUT_OF_RANGE and words in answer.message, answer.message
    assert len(answer.message.splitlines()) == 1
    assert evaluator.probe.call(SetRubric, "reward/set_rubric", SetRubric.Request()).pack == "robot"
    wait_until("the count", lambda: evaluator.probe.value(NODE, "refused_rubrics") == str(before + 1))


def test_a_clip_that_is_none_has_a_verdict_without_reward_and_the_others_have_theirs(
    evaluator: Evaluator, tmp_path: Path
) -> None:
    write_clips(tmp_path, sha256="")
    np.save(tmp_path / "b.npy", np.full((5, 96, 96, 3), np.nan, np.float32))
    result = evaluator.judge(folder=str(tmp_path))
    good, bad = result.verdicts
    assert result.termination_reason == JudgeClips.Result.FINISHED and good.status == ClipVerdict.OK
    assert bad.status != ClipVerdict.OK and np.isnan(bad.reward) and "not finite" in bad.reason
    assert "1 of 2 verdicts are invalid" in result.pause_reason


def test_a_judge_that_is_down_or_late_gives_no_number(
    evaluator: Evaluator, server: PickyServer, tmp_path: Path
) -> None:
    write_clips(tmp_path)
    server.down = True
    down = evaluator.judge(folder=str(tmp_path))
    server.down, server.delay_s = False, 30.0
    late = evaluator.judge(folder=str(tmp_path), deadline_s=0.5)
    for result, why in ((down, "PLAN"), (late, "no verdict by the round's deadline")):
        assert "2 of 2 verdicts are invalid" in result.pause_reason
        for verdict in result.verdicts:
            assert verdict.status == ClipVerdict.ERROR and np.isnan(verdict.reward) and why in verdict.reason


def test_a_cancel_is_answered_at_once_and_the_rubric_stays_while_clips_are_judged(
    evaluator: Evaluator, server: PickyServer, tmp_path: Path
) -> None:
    write_clips(tmp_path)
    server.delay_s = 30.0
    asked = len(server.requests)
    handle = evaluator.goal(folder=str(tmp_path))
    wait_until("calls under way", lambda: len(server.requests) > asked)
    busy = evaluator.probe.call(SetRubric, "reward/set_rubric", SetRubric.Request(pack="robot"))
    assert busy.error_code == ErrorCode.BUSY
    began = time.monotonic()
    handle.cancel_goal_async()
    result = evaluator.probe.finish(handle)
    assert result.termination_reason == JudgeClips.Result.CANCELED and time.monotonic() - began < within(ANSWER_S)
    server.delay_s = 0.0
    assert evaluator.judge(folder=str(tmp_path)).termination_reason == JudgeClips.Result.FINISHED


def test_the_embedded_judge_needs_no_server_no_model_and_no_other_node(tmp_path: Path) -> None:
    """A clip in which nothing moves is done by nobody; one of another size is none that the judge can see."""
    clips = tmp_path / "clips"
    clips.mkdir()
    write_clips(clips)
    start = load_file(shipped_model("push_cube") / "starts.safetensors")["images"][0]
    np.save(clips / "still.npy", np.repeat(start[None], 17, 0))
    words = "push the red cube into the green target"
    (clips / LIST).write_text(
        json.dumps({"file": "still.npy", "instruction": words, "task_id": "push_cube"}) + "\n"
        + json.dumps({"file": "b.npy", "instruction": words, "task_id": "push_cube"}) + "\n"
    )
    with own_domain() as domain:
        evaluator = Evaluator(domain, tmp_path / "run", clips)
        try:
            still, wide = evaluator.judge(folder=str(clips)).verdicts
            assert still.status == ClipVerdict.OK and still.reward < 0.5 and still.judge_id.startswith("embedded:")
            assert wide.status == ClipVerdict.ABSTAIN and "64 x 128" in wide.reason and np.isnan(wide.reward)
        finally:
            evaluator.close()
