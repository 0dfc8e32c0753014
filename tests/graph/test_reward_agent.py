"""The reward agent in the graph, asked over sockets: clips of loop 2 judged, paused, recorded and scored again; and the
episodes of loop 1."""

import json
import math
import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadlines import within
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.video_loop import VideoLoop, settings
from judge_server import PickyServer

from wm_msgs.action import EvaluateClips, Train, TrainVideo
from wm_msgs.msg import ClipScores, ClipVerdict, ErrorCode
from wm_msgs.srv import SetRubric, StartRecording, StopRecording
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.audit.reading import read_record, verify
from wm_nodes.judge.rejudge import judge_bag
from wm_nodes.judge.service import READS, JudgeService
from wm_nodes.launching.scenarios import GRAPH_TOPICS, VERDICT_TOPIC, VIDEO_TOPICS
from wm_nodes.video_rl.recorded_buffers import read_clips

pytestmark = [pytest.mark.graph, pytest.mark.alone]

STAGES = ["VQ", "IF", "TC", "PC"]
ANSWER_S = 1.0
"""A cancel is answered within this time."""
KEY = "a-key-that-nobody-may-see"


@pytest.fixture(scope="module")
def loop(server: PickyServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[VideoLoop]:
    """The running, recorded loop whose only reward is the agent's."""
    config = settings(**{
        "rewards": {"agent": 1.0}, "judge.endpoints": [server.url], "judge.model": "judge", "judge.tries": 1,
        "judge.api_key_env": "WM_TEST_JUDGE_KEY",
    })
    with own_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("WM_TEST_JUDGE_KEY", KEY)
        graph, probe = Graph(domain, tmp_path_factory.mktemp("agent") / "run"), Probe(domain)
        try:
            loop = VideoLoop(graph, probe, config)
            for name in ("clips", "clips/scores", "reward/verdict"):
                probe.listen(name)
            loop.start("video_model")
            loop.start("clip_evaluator", audit_dir="audit")
            loop.start("video_learner")
            graph.start("recorder", topics=list(VIDEO_TOPICS), record_at_start=False)
            loop.wait_active()
            wait_until("the recorder", lambda: probe.value("/wm/recorder", "state") == "active")
            time.sleep(2.0)  # its subscriptions are matched by now
            yield loop
        finally:
            probe.close()
            assert set(graph.stop().values()) == {0}


@pytest.fixture
def judged(loop: VideoLoop, server: PickyServer) -> Iterator[VideoLoop]:
    """The loop, with empty lists and a healthy server."""
    for messages in loop.probe.messages.values():
        messages.clear()
    yield loop
    server.down, server.delay_s = False, 0.0


def forget_reads(graph: Graph) -> None:
    """Have the judge asked again about clips that it has judged."""
    for folder in (graph.folder / READS).iterdir():
        shutil.rmtree(folder)


def scores_of(loop: VideoLoop) -> ClipScores:
    return wait_until("scores", lambda: loop.probe.messages["clips/scores"][-1:])[0]


def evaluate(loop: VideoLoop, **goal: Any) -> Any:
    """A goal for the newest clips; its handle."""
    clips = wait_until("clips", lambda: loop.probe.messages["clips"][-1:])[0]
    client = loop.probe.action(EvaluateClips, "clips/evaluate")
    return loop.probe.send(client, EvaluateClips.Goal(buffer_uri=clips.buffer_uri, sha256=clips.sha256, **goal))


def test_a_round_is_judged_by_the_agent_and_trained_on(judged: VideoLoop, server: PickyServer) -> None:
    result = judged.train(1)
    assert (result.termination_reason, result.message) == (TrainVideo.Result.FINISHED, "")
    verdicts: list[ClipVerdict] = judged.probe.messages["reward/verdict"]
    wait_until("verdicts", lambda: len(verdicts) == 6)
    scores = scores_of(judged)
    assert (scores.reward_name, scores.invalid_reason, scores.pause_reason) == ("agent", "", "")
    assert dict(zip(scores.names, scores.weights, strict=True))["agent"] == 1 and sum(scores.weights) == 1
    rewards = [verdict.reward for verdict in sorted(verdicts, key=lambda verdict: verdict.clip)]
    assert list(scores.total) == rewards and len(set(rewards)) > 1 and all(0 < reward <= 1 for reward in rewards)
    assert sorted(verdict.seq for verdict in verdicts) == list(range(6))
    for verdict in verdicts:
        assert verdict.buffer_sha256 == scores.buffer_sha256 and verdict.clip_id.startswith(scores.buffer_sha256[:12])
        assert (verdict.status, list(verdict.stages)) == (ClipVerdict.OK, STAGES)
        assert list(verdict.stage_passed) == [1] * 4
        assert list(verdict.components) == list(load_rubric().component_names) and all(verdict.component_reasons)
        assert verdict.level == 3 and sum(verdict.level_weights) == pytest.approx(1)
        assert len(verdict.hack_patterns) == 4 and not any(verdict.hack_confirmed)
        assert verdict.calls >= 5 and verdict.prompt_tokens > 0 and math.isnan(verdict.usd)
        assert (verdict.model, verdict.rubric_version) == ("judge", load_rubric().version)
        assert len(verdict.audit_id) == 64
    assert {headers["authorization"] for headers in server.headers} == {f"Bearer {KEY}"}
    board = judged.probe
    wait_until("diagnostics", lambda: board.value("/wm/reward_evaluator", "verdicts") == "6")
    wait_until("the judge's health", lambda: board.value("/wm/reward_evaluator", "judge reads") is not None)
    assert board.value("/wm/reward_evaluator", "breaker") == "closed"
    assert board.value("/wm/reward_evaluator", "invalid_rate") == "0"
    assert float(board.value("/wm/reward_evaluator", "verdict_p50_ms") or 0) > 0


def test_a_judge_that_is_down_pauses_training_and_the_same_clips_are_judged_once_it_is_back(
    judged: VideoLoop, server: PickyServer
) -> None:
    before = judged.train(0)
    server.down = True
    paused = judged.train(1)
    assert paused.termination_reason == TrainVideo.Result.PAUSED
    assert "6 of 6 verdicts are invalid, more than 10%" in paused.message and "train again" in paused.message
    assert (paused.policy_version, paused.iterations) == (before.policy_version, before.iterations)
    scores = scores_of(judged)
    assert not any(scores.valid) and np.isnan(scores.total).all()
    assert "connection failed" in scores.invalid_reason and scores.pause_reason
    wait_until("verdicts", lambda: len(judged.probe.messages["reward/verdict"]) == 6)
    for verdict in judged.probe.messages["reward/verdict"]:
        assert verdict.status == ClipVerdict.ERROR and math.isnan(verdict.reward) and "PLAN" in verdict.reason
        assert list(verdict.stage_status) == [ClipVerdict.SKIPPED] * 4 and verdict.level == -1
    said = judged.probe.seen_errors["/wm/reward_evaluator"]
    wait_until("the alarm", lambda: any("verdicts are invalid" in text for text in said))
    server.down = False
    again = judged.train(1)
    assert (again.termination_reason, again.iterations) == (TrainVideo.Result.FINISHED, before.iterations + 1)
    first, second = judged.probe.messages["clips"]
    assert first.sha256 == second.sha256, "other clips were made after the pause"
    wait_until("no alarm", lambda: not judged.probe.diagnostics["/wm/reward_evaluator"].message.count("invalid"))


def test_clips_without_a_verdict_by_the_deadline_have_no_reward(judged: VideoLoop, server: PickyServer) -> None:
    forget_reads(judged.graph)
    judged.train(1)
    forget_reads(judged.graph)
    told = judged.probe.feedback(EvaluateClips, "clips/evaluate")
    server.delay_s = 30.0
    began = time.monotonic()
    result = judged.probe.finish(evaluate(judged, deadline_s=0.5))
    assert time.monotonic() - began < within(3.0) and result.termination_reason == EvaluateClips.Result.FINISHED
    assert [verdict.status for verdict in result.verdicts] == [ClipVerdict.ERROR] * 6
    assert [verdict.clip for verdict in result.verdicts] == list(range(6))
    assert all("by the round's deadline" in verdict.reason for verdict in result.verdicts)
    last = wait_until("feedback", lambda: [message for message in told if message.clips_done == 6])[0]
    assert last.clips_invalid == 6 and last.progress == 1 and list(last.stages_passed) == [0] * 4


def test_cancel_is_answered_at_once_while_the_judge_hangs(judged: VideoLoop, server: PickyServer) -> None:
    judged.train(1)
    forget_reads(judged.graph)
    server.delay_s = 30.0
    asked, handle = len(server.requests), evaluate(judged)
    wait_until("calls under way", lambda: len(server.requests) > asked)
    began = time.monotonic()
    result = judged.cancel(handle)
    assert time.monotonic() - began < within(ANSWER_S)
    assert result.termination_reason == EvaluateClips.Result.CANCELED


def test_the_rubric_is_told_and_set_but_not_while_clips_are_judged(judged: VideoLoop, server: PickyServer) -> None:
    def rubric(pack: str = "") -> SetRubric.Response:
        return judged.probe.call(SetRubric, "reward/set_rubric", SetRubric.Request(pack=pack))

    before = rubric()
    assert (before.error_code, before.pack, before.version) == (ErrorCode.OK, "robot", load_rubric().version)
    (judged.graph.folder / "strict.yaml").write_text("extends: robot\nname: strict\nstages: {VQ: {threshold: 0.99}}\n")
    (judged.graph.folder / "broken.yaml").write_text("extends: robot\nvoting: {k: 2}\n")
    (judged.graph.folder / "garbage.yaml").write_text("a: [")
    refusals = {"nowhere": "unknown rubric pack", "broken.yaml": "k must be odd", "garbage.yaml": "refused"}
    for pack, words in refusals.items():
        refused = rubric(pack)
        assert refused.error_code == ErrorCode.OUT_OF_RANGE and words in refused.message, refused.message
    assert rubric().version == before.version
    judged.train(1)
    forget_reads(judged.graph)
    server.delay_s = 30.0
    asked, handle = len(server.requests), evaluate(judged)
    wait_until("calls under way", lambda: len(server.requests) > asked)
    assert rubric("strict.yaml").error_code == ErrorCode.BUSY
    judged.cancel(handle)
    server.delay_s = 0.0
    strict = rubric("strict.yaml")
    assert (strict.error_code, strict.pack) == (ErrorCode.OK, "strict.yaml") and strict.version.startswith("strict-1-")
    verdicts = judged.probe.finish(evaluate(judged)).verdicts
    assert {verdict.rubric_version for verdict in verdicts} == {strict.version}
    for verdict in verdicts:
        closed = 0 if verdict.stage_scores[0] >= 0.99 else 3
        assert list(verdict.stage_status).count(ClipVerdict.SKIPPED) == closed
    assert rubric("robot").version == before.version


def test_recorded_verdicts_are_given_again_bit_for_bit_without_asking_the_judge(
    judged: VideoLoop, server: PickyServer, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    probe, folder, run = judged.probe, judged.graph.folder, tmp_path / "run"
    started = probe.call(StartRecording, "recorder/start", StartRecording.Request(bag_uri="bags/round"))
    assert started.error_code == ErrorCode.OK
    done = judged.train(1)
    wait_until("verdicts", lambda: len(probe.messages["reward/verdict"]) == 6)
    stopped = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
    assert stopped.gaps == 0
    for log in folder.rglob("*"):
        assert not log.is_file() or KEY.encode() not in log.read_bytes(), f"{log} holds the key"
    bag = folder / stopped.bag_uri
    (clips,) = read_clips(bag, pictures=True)
    assert clips.iteration == done.iterations - 1 and clips.weights["agent"] == 1
    told = [verdict.audit_id for verdict in probe.messages["reward/verdict"]]
    assert not verify(folder / "audit").problems
    logged = {entry.verdict.audit_id: entry for entry in read_record(folder / "audit").judged() if entry.verdict}
    assert all(logged[audit_id].round_number == clips.iteration for audit_id in told)

    shutil.copytree(judged.bag, run / "data" / "train" / "shard_00000000")
    shutil.copytree(judged.model, run / "video_model")
    shutil.copytree(bag, run / "bags" / "round")
    shutil.copytree(folder / READS, run / READS)
    settings = (folder / "video_config.yaml").read_text()
    (run / "config.yaml").write_text(settings)
    asked = len(server.requests)
    assert main(["rescore", str(run)]) == 0
    assert "bit for bit" in said(capsys) and len(server.requests) == asked
    (run / "config.yaml").write_text(settings.replace(server.url, "http://127.0.0.1:9/v1"))
    shutil.rmtree(run / READS)
    agent = ["--reward", "agent", "--judge", server.url, "--judge-model", "judge"]
    assert main(["rescore", str(run), *agent]) == 0
    assert len(server.requests) > asked
    assert main(["rescore", str(run), "--reward", "reference"]) == 0
    assert "by other rewards than recorded, so it is not compared" in said(capsys)
    silent, other = (
        replace(clips, scores={**clips.scores, "agent": clips.scores["agent"].clone()}, total=clips.total.clone())
        for _ in range(2)
    )
    silent.scores["agent"][0] = silent.total[0] = math.nan
    other.scores["agent"][0] += 1e-15
    monkeypatch.setattr("wm_nodes.video_rl.recorded_buffers.read_clips", lambda bag, pictures: [silent])
    assert main(["rescore", str(run), *agent]) == 0
    assert "1 clips that got no reward then are not compared" in said(capsys)
    monkeypatch.setattr("wm_nodes.video_rl.recorded_buffers.read_clips", lambda bag, pictures: [other])
    assert main(["rescore", str(run), *agent]) == 1
    assert json.loads((run / "rescored.json").read_text())["buffers"][0]["different"] == ["agent"]


def said(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def _made(transitions: list[Any]) -> dict[int, Any]:
    """Of those that have arrived, by number, the lock-steps in which something moved; more may be on their way."""
    return {step.step_id: step for step in transitions if any(step.valid)}


def test_a_policys_episodes_are_judged_at_their_end_and_a_judge_that_is_down_pauses_training(
    server: PickyServer, tmp_path: Path
) -> None:
    judge = {"judge.endpoints": [server.url], "judge.model": "judge", "judge.tries": 1}
    config = load_config("smoke", {"ppo.num_steps": 16, **judge})
    with own_domain() as domain:
        graph, probe = Graph(domain, tmp_path / "run", config), Probe(domain)
        try:
            rewards, verdicts = probe.listen("reward"), probe.listen("reward/verdict")
            metrics = probe.listen("learner/metrics")
            graph.start("recorder", topics=[*GRAPH_TOPICS, VERDICT_TOPIC])
            transitions = probe.listen("env/transition")
            graph.start_environment()
            graph.start_policy(await_nodes=["environment", "reward_evaluator", "learner", "recorder"])
            graph.start("reward_evaluator", reward="agent")
            graph.start_learner(join_timeout_s=60.0)
            client = probe.action(Train, "train")
            result = probe.finish(probe.send(client, Train.Goal(updates=1)))
            assert (result.termination_reason, result.message) == (Train.Result.FINISHED, "")
            wait_until("transitions", lambda: len(transitions) > config.ppo.num_steps)  # and that of the reset
            wait_until("rewards", lambda: {reward.step_id for reward in rewards} == _made(transitions).keys())
            steps = _made(transitions)
            ended = {
                (number, env): step.episode_id[env]
                for number, step in steps.items()
                for env in range(step.num_envs)
                if step.valid[env] and (step.terminated[env] or step.truncated[env])
            }
            told = {(verdict.iteration, verdict.clip): verdict for verdict in verdicts}
            assert told.keys() == ended.keys() and ended
            begun = {step.episode_id[env] for step in steps.values() for env in range(step.num_envs) if step.valid[env]}
            cut = len(begun - set(ended.values()))
            (update,) = wait_until("metrics", lambda: metrics[:])
            assert dict(zip(update.names, update.values, strict=True))["cut_episodes"] == cut
            for message in rewards:
                assert message.reward_name == "agent" and list(message.valid) == list(steps[message.step_id].valid)
                for env, total in enumerate(message.total):
                    verdict = told.get((message.step_id, env))
                    if message.valid[env]:
                        assert total == (np.float32(verdict.reward) if verdict else 0)
            for key, verdict in told.items():
                assert verdict.status == ClipVerdict.OK
                assert verdict.clip_id.startswith(f"episode {ended[key]} of session")
                assert verdict.header.stamp == steps[key[0]].header.stamp
            server.down = True
            forget_reads(graph)
            paused = probe.finish(probe.send(client, Train.Goal(updates=1)))
            assert paused.termination_reason == Train.Result.PAUSED and "ended without a verdict" in paused.message
            assert paused.updates == 1
            server.down = False
            again = probe.finish(probe.send(client, Train.Goal(updates=1)))
            assert (again.termination_reason, again.updates) == (Train.Result.FINISHED, 2)
            bag = probe.call(StopRecording, "recorder/stop", StopRecording.Request()).bag_uri
            with closing(JudgeService(config.judge, seed=config.seed, reads=graph.folder / READS)) as again:
                offline = judge_bag(graph.folder / bag, again)
            assert offline.compared and offline.unanswered and not offline.different
            _assert_same_weights_from(graph, graph.folder / bag)
        finally:
            server.down = False
            probe.close()
            assert set(graph.stop().values()) == {0}


def _assert_same_weights_from(live: Graph, bag: Path) -> None:
    """Train on the recording, which holds the rollout without verdicts and its repetition."""
    with own_domain() as domain:
        graph, probe = Graph(domain, live.folder.parent / "offline", live.config), Probe(domain)
        try:
            graph.start_learner(allowed_dirs=[str(bag)])
            goal = Train.Goal(updates=2, from_bags=True, bag_uris=[str(bag)])
            result = probe.finish(probe.send(probe.action(Train, "train"), goal))
            assert (result.termination_reason, result.message) == (Train.Result.FINISHED, "")
            newest = f"policies/policy_{result.policy_version:06d}.safetensors"
            assert (graph.folder / newest).read_bytes() == (live.folder / newest).read_bytes()
        finally:
            probe.close()
            assert set(graph.stop().values()) == {0}
