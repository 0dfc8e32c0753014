"""Which judge a clip has, and what an outage of its server over real sockets does."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chat_server import Fault
from judge_server import PickyServer, serving
from scripted_judge import make_clip, make_task

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.judge.agent.contract import pause_reason
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.reading import read_record
from wm_nodes.judge.backends.factory import check_clips, check_judge, for_task
from wm_nodes.judge.backends.one_class import OneClassJudge
from wm_nodes.judge.check_set import load_check_set
from wm_nodes.judge.one_class.ranges import COMPONENTS
from wm_nodes.judge.service import ClipJob, JudgeService

JUDGE = "openai-chat:first"
NUM_CLIPS = 10


@pytest.fixture
def server() -> Iterator[PickyServer]:
    with serving(PickyServer()) as served:
        assert isinstance(served, PickyServer)
        yield served


def settings(server: PickyServer, **changes: object) -> JudgeConfig:
    values = {"endpoints": [server.url], "model": "first", "tries": 1}
    return JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **values, **changes})


def jobs(count: int = NUM_CLIPS) -> list[ClipJob]:
    return [ClipJob(clip, replace(make_task(clip), instruction=clip.clip_id)) for clip in map(make_clip, range(count))]


def judges(verdicts: list[Verdict]) -> set[str]:
    return {verdict.provenance.judge_id for verdict in verdicts}


def embedded(**changes: object) -> JudgeConfig:
    return JudgeConfig.model_validate({**load_config("base").judge.model_dump(), "kind": "embedded", **changes})


def test_while_no_server_answers_no_clip_has_a_reward_and_training_pauses_and_then_it_goes_on(
    server: PickyServer,
) -> None:
    server.down = True
    with closing(JudgeService(settings(server), seed=0)) as judge:
        verdicts = judge.judge(jobs())
        assert {verdict.status for verdict in verdicts} == {Status.ERROR} and judges(verdicts) == {JUDGE}
        assert np.isnan([v.reward for v in verdicts]).all() and "10 of 10 verdicts" in pause_reason(verdicts)
        server.down = False
        assert {verdict.status for verdict in judge.judge(jobs(2))} == {Status.OK}


def test_answers_that_are_no_answers_give_no_reward(server: PickyServer) -> None:
    server.faults.extend([Fault("status", 503), Fault("garbage"), Fault("truncated"), Fault("empty")])
    with closing(JudgeService(settings(server, concurrency=1), seed=0)) as judge:
        assert [verdict.status for verdict in judge.judge(jobs(5))] == [Status.ERROR] * 4 + [Status.OK]


def test_a_clip_without_a_verdict_by_the_rounds_deadline_has_no_reward(server: PickyServer) -> None:
    server.delay_s = 30.0
    with closing(JudgeService(settings(server), seed=0)) as judge:
        verdicts = judge.judge(jobs(2), within_s=0.3)
    assert {verdict.reason for verdict in verdicts} == {"no verdict by the round's deadline"}


def test_the_embedded_judge_says_what_it_cannot_tell_and_refuses_clips_of_another_size() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 16, 64, 128, 3), np.uint8)
    some = [
        replace(job, clip=replace(job.clip, frames=clip), task=replace(job.task, reference_frame=clip[0]))
        for job, clip in zip(jobs(2), frames, strict=True)
    ]
    chosen = embedded(folder=str(shipped_model("push_cube")))
    check_clips(chosen, (16, 64, 128, 3), 5.0)
    with closing(JudgeService(chosen, seed=0)) as judge:
        verdicts = judge.judge(some)
        assert judge.judge_id.startswith("embedded:") and judges(verdicts) == {judge.judge_id}
        (card,) = judge.cards
        assert judge.judge_id.removeprefix("embedded:") in card and "recordings" in card
    assert {verdict.status for verdict in verdicts} == {Status.ABSTAIN}, "its recordings have no such words"
    with pytest.raises(ValueError, match=r"cannot judge clips of 8 frames, 32 x 64 px.* Name a server"):
        check_clips(chosen, (8, 32, 64, 3))


def test_every_clip_is_judged_by_the_judge_of_its_task_and_on_one_without_a_judge_it_abstains_and_says_why() -> None:
    tasks = ("push_cube", "push", "pull_cube", "reach")
    some = [replace(job, task=replace(job.task, task_id=task)) for job, task in zip(jobs(4), tasks, strict=True)]
    with closing(JudgeService(embedded(), seed=0, tasks=tasks)) as judge:
        verdicts = judge.judge(some)
        table, scenes = judge.judge_of("push_cube"), judge.judge_of("push")
    assert table != scenes and [v.provenance.judge_id for v in verdicts] == [table, scenes, table, table]
    assert verdicts[2].status is Status.ABSTAIN and "no judge is shipped for task 'pull_cube'" in verdicts[2].reason
    with pytest.raises(ValueError, match="no judge is shipped for task 'pull_cube'"):
        JudgeService(embedded(), seed=0, tasks=["pull_cube"])


def test_beside_a_server_the_world_models_normal_ranges_are_evidence(server: PickyServer, tmp_path: Path) -> None:
    clip = next(one for one in load_check_set() if one.truth.part == "policy")
    folder = shipped_model("push_cube")
    with closing(JudgeService(settings(server), seed=0, audit=tmp_path, model_dir=folder)) as judge:
        judge.judge([clip.job, *jobs(1)])
    known, other = read_record(tmp_path).judged()
    assert set(known.evidence) == set(COMPONENTS.values()) and other.evidence == {}, "of other pictures there is none"
    assert known.evidence == OneClassJudge(folder).evidence(clip.job.clip, clip.job.task)


def test_an_embedded_judge_that_is_not_named_is_the_shipped_one_of_the_task_and_others_stay() -> None:
    nobody, here = {"kind": "embedded"}, {"kind": "embedded", "folder": "mine"}
    other, unnamed = {**here, "stages": ["TC"]}, {**nobody, "stages": ["PC"]}
    values = {**load_config("base").judge.model_dump(), **nobody, "routes": [other, unnamed]}
    chosen, shipped = for_task(JudgeConfig.model_validate(values), "push_cube"), str(shipped_model("push_cube"))
    assert [chosen.folder, *(route.folder for route in chosen.routes)] == [shipped, "mine", shipped]
    with pytest.raises(ValueError, match=r"no judge is shipped for task 'pull_cube' .*judge calibrate"):
        for_task(JudgeConfig.model_validate(values), "pull_cube")


@pytest.mark.parametrize(
    ("route", "words"),
    [
        ({}, r"judge\.routes\[0\]: .*set judge\.endpoints"),
        ({"kind": "embedded", "folder": "/no/folder"}, r"judge\.routes\[0\]: .*/no/folder"),
    ],
    ids=["nobody", "embedded_elsewhere"],
)
def test_a_route_to_nobody_is_refused_by_name(route: dict[str, object], words: str) -> None:
    server = {"endpoints": ["http://a/v1"], "model": "first", "routes": [{**route, "stages": ["TC"]}]}
    with pytest.raises(ValueError, match=words):
        check_judge(JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **server}))
