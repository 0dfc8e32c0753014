"""A judge's outage over real sockets: another judge takes the whole round, never a part, and only if configured."""

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chat_server import Fault
from judge_server import PickyServer, serving
from scripted_judge import make_clip, make_task

from wm_nodes.config.load import ConfigError, default_judge, dump_config, load_config, load_video_config
from wm_nodes.config.schema import JudgeConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.judge.agent.contract import check_one_judge, pause_reason
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.reading import read_record, verify
from wm_nodes.judge.backends.factory import check_clips, check_judge, for_task, judges_of
from wm_nodes.judge.backends.limits import CircuitBreaker
from wm_nodes.judge.backends.one_class import OneClassJudge
from wm_nodes.judge.check_set import load_check_set
from wm_nodes.judge.episode_reward import EpisodeReward, check_agent
from wm_nodes.judge.one_class.ranges import COMPONENTS
from wm_nodes.judge.service import ClipJob, JudgeService

FIRST, SECOND = "openai-chat:first", "openai-chat:second"
NUM_CLIPS = 10


@dataclass
class Server(PickyServer):
    """dies_after: requests; it resets all further ones. never: it resets those about the clip of this name."""

    dies_after: int = 1 << 30
    never: str = "no clip"

    async def _answer(self, writer: asyncio.StreamWriter, body: dict[str, Any]) -> None:
        if len(self.requests) > self.dies_after or self.never in json.dumps(body["messages"]):
            writer.transport.abort()
            return
        await super()._answer(writer, body)


Servers = tuple[Server, Server]


@pytest.fixture
def servers() -> Iterator[Servers]:
    with ExitStack() as stack:
        first, second = (stack.enter_context(serving(Server())) for _ in range(2))
        assert isinstance(first, Server) and isinstance(second, Server)
        yield first, second


def settings(servers: Servers, **changes: object) -> JudgeConfig:
    first, second = servers
    fallback = {"endpoints": [second.url], "model": "second"}
    values = {"endpoints": [first.url], "model": "first", "tries": 1, "fallbacks": [fallback]}
    return JudgeConfig.model_validate({**default_judge().model_dump(), **values, **changes})


@pytest.fixture
def wait_for_probe(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Lets the time pass after which an open circuit breaker lets one call through."""
    ahead_s = [0.0]

    def breaker(now: Callable[[], float], **settings: float) -> CircuitBreaker:
        return CircuitBreaker(lambda: now() + ahead_s[0], probe_s=settings["probe_s"])

    def wait() -> None:
        ahead_s[0] += 11.0

    monkeypatch.setattr("wm_nodes.judge.backends.transport.CircuitBreaker", breaker)
    return wait


def jobs(count: int = NUM_CLIPS) -> list[ClipJob]:
    return [ClipJob(clip, replace(make_task(clip), instruction=clip.clip_id)) for clip in map(make_clip, range(count))]


def judges(verdicts: list[Verdict]) -> set[str]:
    return {verdict.provenance.judge_id for verdict in verdicts}


@pytest.mark.slow
def test_an_outage_gives_the_whole_round_to_the_next_judge_and_the_round_after_to_the_first_again(
    servers: Servers, tmp_path: Path, wait_for_probe: Callable[[], None]
) -> None:
    first, second = servers
    with closing(JudgeService(settings(servers, tries=2), seed=0, audit=tmp_path)) as judge:
        for number, down in enumerate((False, True, True, False)):
            wait_for_probe()
            first.down, told = down, dict[int, Verdict]()
            asked = len(second.requests)
            verdicts = judge.judge(jobs(), done=told.__setitem__, round_number=number)
            assert all(verdict.status is not Status.ERROR for verdict in verdicts)
            assert [verdict.clip_id for verdict in verdicts] == [f"clip{clip}" for clip in range(NUM_CLIPS)]
            assert {clip: verdict.audit_id for clip, verdict in told.items()} == {
                clip: verdict.audit_id for clip, verdict in enumerate(verdicts)
            }
            assert judges(verdicts) == {SECOND if down else FIRST} == {judge.judge_id}
            assert (len(second.requests) > asked) == down
            if down:
                assert f"{FIRST} did not answer" in judge.fallen_back
                assert judge.fallen_back.endswith(f"the round went to {SECOND}")
            else:
                assert judge.fallen_back == ""
    assert not verify(tmp_path).problems
    stood = [e.verdict for e in read_record(tmp_path).judged(1) if e.verdict and e.verdict.status is not Status.ERROR]
    assert judges(stood) == {SECOND} and len(stood) == NUM_CLIPS


def test_a_judge_that_dies_in_a_round_loses_it_with_all_it_has_said_and_no_group_mixes_two(servers: Servers) -> None:
    first, _ = servers
    first.dies_after = 40
    said = list[Verdict]()
    with closing(JudgeService(settings(servers, concurrency=1), seed=0)) as judge:
        verdicts = judge.judge(jobs(), done=lambda clip, verdict: said.append(verdict))
        judged_before_it_died = judge.tally.by_status[Status.OK] - NUM_CLIPS
    assert judged_before_it_died > 0, "the first judge was to die in the middle"
    assert judges(verdicts) == judges(said) == {SECOND} and len(said) == NUM_CLIPS
    check_one_judge(verdicts, [clip // 5 for clip in range(NUM_CLIPS)])


def test_a_few_clips_without_an_answer_stay_without_a_reward_and_with_the_judge(servers: Servers) -> None:
    servers[0].never = "clip3"
    with closing(JudgeService(settings(servers), seed=0)) as judge:
        verdicts = judge.judge(jobs())
        assert judge.fallen_back == ""
    assert [verdict.clip_id for verdict in verdicts if not verdict.valid] == ["clip3"]
    assert verdicts[3].status is Status.ERROR and np.isnan(verdicts[3].reward) and judges(verdicts) == {FIRST}
    assert pause_reason(verdicts) == "" and not servers[1].requests


def test_answers_that_are_no_answers_are_an_outage_too(servers: Servers) -> None:
    servers[0].faults.extend([Fault("status", 503), Fault("garbage"), Fault("truncated"), Fault("empty")])
    with closing(JudgeService(settings(servers), seed=0)) as judge:
        assert judges(judge.judge(jobs(4))) == {SECOND}


def test_when_no_judge_answers_no_clip_has_a_reward_and_training_pauses(servers: Servers) -> None:
    for server in servers:
        server.down = True
    with closing(JudgeService(settings(servers), seed=0)) as judge:
        verdicts = judge.judge(jobs())
        assert FIRST in judge.fallen_back and len(verdicts) == NUM_CLIPS
    assert {verdict.status for verdict in verdicts} == {Status.ERROR} and judges(verdicts) == {SECOND}
    assert np.isnan([verdict.reward for verdict in verdicts]).all() and "10 of 10 verdicts" in pause_reason(verdicts)


def test_without_a_fallback_in_the_settings_nobody_else_is_asked(servers: Servers) -> None:
    servers[0].down = True
    with closing(JudgeService(settings(servers, fallbacks=[]), seed=0)) as judge:
        verdicts = judge.judge(jobs())
    assert judges(verdicts) == {FIRST} and pause_reason(verdicts) and not servers[1].requests


def test_an_open_breaker_asks_nothing_of_the_server_and_closes_with_the_first_clip_once_it_is_back(
    servers: Servers, wait_for_probe: Callable[[], None]
) -> None:
    """The clip that is sent ahead is the one probe; without it the others would be refused, and the round lost."""
    first, _ = servers
    first.down = True
    with closing(JudgeService(settings(servers), seed=0)) as judge:
        while len(first.requests) < 20:
            assert judges(judge.judge(jobs(1))) == {SECOND}
        asked = len(first.requests)
        judge.judge(jobs(1))
        assert "circuit breaker" in judge.fallen_back and len(first.requests) == asked
        first.down = False
        wait_for_probe()
        assert judges(judge.judge(jobs())) == {FIRST} and judge.fallen_back == ""


def test_a_judge_that_hangs_until_the_rounds_deadline_keeps_it_and_one_that_times_out_before_loses_it(
    servers: Servers,
) -> None:
    servers[0].delay_s = 30.0
    with closing(JudgeService(settings(servers), seed=0)) as judge:
        verdicts = judge.judge(jobs(2), within_s=0.3)
        assert {verdict.reason for verdict in verdicts} == {"no verdict by the round's deadline"}
        assert judges(verdicts) == {FIRST} and not servers[1].requests
    with closing(JudgeService(settings(servers, json_timeout_s=0.2), seed=0)) as judge:
        assert judges(judge.judge(jobs(2), within_s=20.0)) == {SECOND}


def test_a_round_is_judged_again_by_the_judge_that_is_named(servers: Servers) -> None:
    with closing(JudgeService(settings(servers), seed=0)) as judge:
        assert judge.judge_ids == [FIRST, SECOND]
        assert judges(judge.judge(jobs(2), by=SECOND)) == {SECOND} and not servers[0].requests
        with pytest.raises(ValueError, match=f"no judge 'nobody' to ask, only {FIRST}, {SECOND}"):
            judge.judge(jobs(2), by="nobody")


def test_the_embedded_judge_takes_a_round_of_clips_of_its_size_and_keeps_what_it_cannot_tell(servers: Servers) -> None:
    servers[0].down = True
    frames = np.random.default_rng(0).integers(0, 256, (2, 16, 64, 128, 3), np.uint8)
    some = [
        replace(job, clip=replace(job.clip, frames=clip), task=replace(job.task, reference_frame=clip[0]))
        for job, clip in zip(jobs(2), frames, strict=True)
    ]
    folder = str(shipped_model("push_cube"))
    embedded = settings(servers, fallbacks=[{"kind": "embedded", "folder": folder}])
    check_clips(embedded, (16, 64, 128, 3), 5.0)
    with closing(JudgeService(embedded, seed=0)) as judge:
        verdicts = judge.judge(some)
        assert judge.judge_id.startswith("embedded:") and judges(verdicts) == {judge.judge_id}
        (card,) = judge.cards
        assert judge.judge_id.removeprefix("embedded:") in card and "recordings" in card
    assert {verdict.status for verdict in verdicts} == {Status.ABSTAIN}, "its recordings have no such words"
    asked = [len(server.requests) for server in servers]
    fallback = {"endpoints": [servers[1].url], "model": "second"}
    first = settings(servers, kind="embedded", folder=folder, fallbacks=[fallback])
    with closing(JudgeService(first, seed=0)) as judge:
        stays = judge.judge(some)
    assert judges(stays) == judges(verdicts) and [len(server.requests) for server in servers] == asked, (
        "a judge that cannot say has answered: nobody else is asked"
    )
    with pytest.raises(ValueError, match=r"cannot judge clips of 8 frames, 32 x 64 px.* Name a server"):
        check_clips(embedded, (8, 32, 64, 3))


def test_beside_a_server_the_world_models_normal_ranges_are_evidence(servers: Servers, tmp_path: Path) -> None:
    clip = next(one for one in load_check_set() if one.truth.part == "policy")
    folder = shipped_model("push_cube")
    with closing(JudgeService(settings(servers), seed=0, audit=tmp_path, model_dir=folder)) as judge:
        judge.judge([clip.job, *jobs(1)])
    known, other = read_record(tmp_path).judged()
    assert set(known.evidence) == set(COMPONENTS.values()) and other.evidence == {}, "of other pictures there is none"
    assert known.evidence == OneClassJudge(folder).evidence(clip.job.clip, clip.job.task)


def test_an_embedded_judge_that_is_not_named_is_the_shipped_one_of_the_task_and_others_stay() -> None:
    nobody, here = {"kind": "embedded"}, {"kind": "embedded", "folder": "mine"}
    other, server = {**here, "stages": ["TC"]}, {"endpoints": ["http://b/v1"], "model": "first"}
    values = {**default_judge().model_dump(), **nobody, "routes": [other], "fallbacks": [nobody, server]}
    found, shipped = for_task(JudgeConfig.model_validate(values), "push_cube"), str(shipped_model("push_cube"))
    assert [found.folder, found.fallbacks[0].folder] == [shipped] * 2
    assert found.routes[0].folder == "mine" and found.fallbacks[1].folder == ""
    with pytest.raises(ValueError, match=r"no judge is shipped for task 'pull_cube' .*judge calibrate"):
        for_task(JudgeConfig.model_validate(values), "pull_cube")


@pytest.mark.parametrize(
    ("fallback", "words"),
    [
        ({}, r"judge\.fallbacks\[0\]: .*set judge\.endpoints"),
        ({"kind": "embedded", "folder": "/no/folder"}, r"judge\.fallbacks\[0\]: .*/no/folder"),
        ({"endpoints": ["http://b/v1"], "model": "first"}, r"'first' once more; further servers of one model"),
    ],
    ids=["nobody", "embedded_elsewhere", "the_same"],
)
def test_fallbacks_that_are_nobody_or_the_judge_itself_are_refused_by_name(fallback: object, words: str) -> None:
    values = {**default_judge().model_dump(), "endpoints": ["http://a/v1"], "model": "first", "fallbacks": [fallback]}
    with pytest.raises(ValueError, match=words):
        check_judge(JudgeConfig.model_validate(values))


def test_fallbacks_are_settings_of_loop_2_and_a_policys_judge_refuses_them(servers: Servers, tmp_path: Path) -> None:
    fallbacks = [{"kind": "embedded"}]
    config = load_video_config("smoke", {"judge.fallbacks": fallbacks})
    (tmp_path / "config.yaml").write_text(dump_config(config))
    assert load_video_config(str(tmp_path / "config.yaml")) == config
    assert [judge.kind for judge in judges_of(config.judge)] == ["openai", "embedded"]
    with pytest.raises(ConfigError, match="fallback"):
        load_video_config("smoke", {"judge.fallbacks": [{"kindness": 1}]})
    policy = {"ppo.num_steps": 16, "judge.endpoints": ["http://a/v1"], "judge.model": "m", "judge.fallbacks": fallbacks}
    with pytest.raises(ValueError, match="whole rounds of loop 2 only"):
        check_agent(load_config("smoke", policy))
    with (
        closing(JudgeService(settings(servers), seed=0)) as judge,
        pytest.raises(ValueError, match="whole rounds of loop 2 only"),
    ):
        EpisodeReward(judge)
