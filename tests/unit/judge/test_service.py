"""Many clips through the reward agent from plain threads: order, places, deadlines, stops; and its settings."""

import asyncio
import json
import re
import time
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from deadlines import PATIENCE_S, within
from graph.video_loop import write_contexts
from judge_server import PickyServer, serving
from recording_samples import make_spec
from rl_toys import toy_policy, toy_ppo, toy_rollout
from scripted_judge import make_clip, make_task
from video_toys import changed_judge

from wm_nodes.apps.cli import main
from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import dump_config, judge_overrides, load_config, load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.named_files import NamedFiles, OutsideFolders
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.media import FOLDER
from wm_nodes.judge.audit.reading import read_record
from wm_nodes.judge.backends.factory import check_judge, judge_name
from wm_nodes.judge.episode_reward import EpisodeReward, PendingReward, check_agent, check_horizon, unjudged_reason
from wm_nodes.judge.service import ClipJob, JudgeService
from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching.graph import Graph, GraphError
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.rollouts import tensors_of, terminate_at_episode_end

JUDGE = ("--judge", "http://127.0.0.1:9/v1", "--judge-model", "judge")
SPEC = make_spec(num_envs=2, height=8, width=8)


def settings(server: PickyServer, **changes: object) -> JudgeConfig:
    values = {"endpoints": [server.url], "model": "judge", "tries": 1, **changes}
    return JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **values})


def jobs(count: int) -> list[ClipJob]:
    return [ClipJob(clip, make_task(clip)) for clip in map(make_clip, range(count))]


def test_verdicts_come_in_the_order_of_the_jobs_and_every_one_is_told_and_audited(
    server: PickyServer, tmp_path: Path
) -> None:
    told = dict[int, Verdict]()
    with closing(JudgeService(settings(server), seed=0, audit=tmp_path)) as judge:
        verdicts = judge.judge(jobs(5), done=told.__setitem__, round_number=3)
        assert [verdict.clip_id for verdict in verdicts] == [f"clip{index}" for index in range(5)]
        assert [told[index] for index in range(5)] == verdicts
        assert all(verdict.valid for verdict in verdicts) and len({verdict.reward for verdict in verdicts}) > 1
        assert (judge.tally.verdicts, judge.tally.invalid_rate) == (5, 0)
        assert judge.tally.cost.calls == sum(verdict.cost.calls for verdict in verdicts) == len(server.requests)
    record = read_record(tmp_path)
    assert {e.verdict.clip_id: e.verdict for e in record.judged()} == {verdict.clip_id: verdict for verdict in verdicts}
    assert all(e.exchanges and e.round_number == 3 for e in record.judged())


@pytest.mark.parametrize("places", [1, 3])
def test_no_more_clips_than_places_are_judged_at_once(server: PickyServer, places: int) -> None:
    """With one place the server is asked about one clip after the other; with three about them in turn."""
    server.delay_s = 0.02
    three = [ClipJob(job.clip, replace(job.task, instruction=job.clip.clip_id)) for job in jobs(3)]
    with closing(JudgeService(settings(server, concurrency=places), seed=0)) as judge:
        judge.judge(three)
    asked = [re.findall(r"clip\d", json.dumps(request["messages"]))[-1] for request in server.requests]
    turns = len(list(groupby(asked)))
    assert turns == 3 if places == 1 else turns > 3


def test_a_stop_while_the_judge_hangs_is_seen_at_once_and_drops_what_is_under_way(server: PickyServer) -> None:
    server.delay_s = 30.0

    def check() -> None:
        if server.requests:
            raise KeyboardInterrupt

    with closing(JudgeService(settings(server, concurrency=1), seed=0)) as judge:
        with pytest.raises(KeyboardInterrupt):
            judge.judge(jobs(2), check=check)
        server.delay_s = 0.0
        (verdict,) = judge.judge(jobs(1), within_s=10.0)
        assert verdict.valid, "the place was not given back"


def test_clips_without_a_verdict_by_the_deadline_say_so_and_have_no_reward(server: PickyServer) -> None:
    server.delay_s = 30.0
    with closing(JudgeService(settings(server, concurrency=1), seed=0)) as judge:
        verdicts = judge.judge(jobs(3), within_s=0.3)
        assert judge.tally.by_status == {Status.ERROR: 3} and judge.tally.invalid_rate == 1
    assert all(np.isnan(verdict.reward) for verdict in verdicts)
    assert {verdict.reason for verdict in verdicts} == {"no verdict by the round's deadline"}


def test_a_clip_that_the_deadline_cuts_costs_what_was_answered_and_is_audited(tmp_path: Path) -> None:
    class Tiring(PickyServer):
        async def _answer(self, writer: asyncio.StreamWriter, body: dict[str, Any]) -> None:
            self.delay_s = 30.0 if len(self.requests) > 2 else 0.0
            await super()._answer(writer, body)

    with serving(Tiring()) as server, closing(JudgeService(settings(server), seed=0, audit=tmp_path)) as judge:
        (verdict,) = judge.judge(jobs(1), within_s=within(1.0))
        assert verdict.status is Status.ERROR and verdict.reason == "no verdict by the round's deadline"
        assert verdict.cost.calls == 2 and verdict.cost.prompt_tokens > 0 and verdict.num_reads > 2
        assert judge.tally.cost == verdict.cost
    (evaluation,) = read_record(tmp_path).judged()
    assert evaluation.verdict.audit_id == verdict.audit_id


def test_answers_that_were_kept_give_the_same_verdicts_without_a_server(server: PickyServer, tmp_path: Path) -> None:
    ids = []
    for down in (False, True):
        server.down = down
        with closing(JudgeService(settings(server), seed=0, reads=tmp_path)) as judge:
            ids.append([verdict.audit_id for verdict in judge.judge(jobs(3))])
    assert ids[0] == ids[1]


def test_a_rubric_that_is_refused_leaves_the_one_before(server: PickyServer, tmp_path: Path) -> None:
    (tmp_path / "many.yaml").write_text("extends: robot\nname: many\n")
    with closing(JudgeService(settings(server, max_reads=30), seed=0)) as judge:
        before = judge.rubric.version
        with pytest.raises(ValueError, match="unknown rubric pack"):
            judge.set_rubric("nowhere.yaml", NamedFiles(tmp_path))
        assert judge.rubric.version == before
        (tmp_path / "outside.yaml").write_text(f"extends: {tmp_path.parent}/outside.yaml\nname: outside\n")
        with pytest.raises(OutsideFolders):
            judge.set_rubric("outside.yaml", NamedFiles(tmp_path))
        judge.set_rubric("many.yaml", NamedFiles(tmp_path))
        assert judge.rubric.version.startswith("many-1-")
        assert judge.judge(jobs(1))[0].provenance.rubric_version == judge.rubric.version


# Episodes


def step(number: int, *, ended: tuple[bool, bool] = (False, False), ids: tuple[int, int] = (1, 2),
         numbers: tuple[int, int] | None = None, lost: bool = False) -> LockStep:
    images = np.random.default_rng(number).integers(0, 256, (2, 2, 8, 8, 3), np.uint8)
    zeros, none = np.zeros(2, np.float32), np.zeros(2, bool)
    return LockStep(
        session=7, step_id=number, stamp_ns=10 * number, next_stamp_ns=10 * number + 10,
        actions=np.full((2, 3), 0.5, np.float32), states=np.zeros((2, 3), np.float32),
        next_states=np.zeros((2, 3), np.float32), logprobs=zeros, values=zeros, terminated=np.array(ended),
        truncated=none, valid=~none, episode_ids=np.array(ids, np.uint64),
        episode_steps=np.array(numbers or (number, number), np.uint32), policy_versions=np.zeros(2, np.uint64),
        success_probability=zeros, uncertainty=zeros, ground_truth=np.zeros((2, 0), np.float32), source=0,
        images=None if lost else images[0], next_images=images[1],
    )


def wait_for(pending: PendingReward) -> PendingReward:
    deadline = time.monotonic() + PATIENCE_S
    while not pending.done:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return pending


def test_an_episode_is_paid_at_its_last_step_and_not_before(server: PickyServer) -> None:
    heard: list[ClipJob] = []

    class Listening(JudgeService):
        def submit(self, job: ClipJob, deadline: float | None = None) -> "Future[Verdict]":
            heard.append(job)
            return super().submit(job, deadline)

    with closing(Listening(settings(server), seed=0)) as judge:
        model = EpisodeReward(judge)
        goal = np.full((8, 8, 3), 7, np.uint8)
        goals = np.stack([goal, goal]), np.array([True, False])
        first, second = replace(step(0), goals=goals), step(1, ended=(True, False))
        early = model.add(first, SPEC)
        assert early.done and list(early.result().total) == [0, 0] and list(early.result().valid) == [True, True]
        late = wait_for(model.add(second, SPEC))
        (verdict,) = late.verdicts().values()
        result = late.result()
        assert list(result.total) == [np.float32(verdict.reward), 0] and list(result.valid) == [True, True]
        assert verdict.reward > 0 and verdict.clip_id == "episode 1 of session 7"
    (job,) = heard
    assert first.images is not None and first.next_images is not None and second.next_images is not None
    np.testing.assert_array_equal(job.clip.frames, [first.images[0], first.next_images[0], second.next_images[0]])
    assert job.clip.fps == pytest.approx(10) and job.task.instruction == SPEC.instruction
    assert job.task.actions is not None and job.task.actions.shape == (2, 3)
    assert job.task.goal_image is not None and (job.task.goal_image == goal).all()
    sent = [part for request in server.requests for part in request["messages"][1]["content"] if part["type"] == "text"]
    assert any(part["text"] == "goal image" for part in sent)


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ([step(0, lost=True), step(1, ended=(True, False))], "environment 0: no image of step 0 of episode 1"),
        ([step(3, ended=(True, False))], "environment 0: step 0 of episode 1 was not seen"),
        ([step(0), step(2, ended=(True, False))], "environment 0: step 1 of episode 1 was not seen"),
    ],
    ids=["image_lost", "beginning_unseen", "step_missed"],
)
def test_an_episode_that_was_not_seen_whole_has_no_reward_and_is_not_judged(
    server: PickyServer, steps: list[LockStep], words: str
) -> None:
    with closing(JudgeService(settings(server), seed=0)) as judge:
        model = EpisodeReward(judge)
        result = [wait_for(model.add(one, SPEC)) for one in steps][-1].result()
        assert list(result.valid) == [False, True] and np.isnan(result.total[0]) and words in result.invalid_reason
        assert not server.requests


def test_an_episode_that_was_cut_short_leaves_nothing_to_the_next_one(server: PickyServer) -> None:
    with closing(JudgeService(settings(server), seed=0)) as judge:
        model = EpisodeReward(judge)
        model.add(step(0), SPEC)
        pending = model.add(step(0, ids=(3, 4), ended=(True, False)), SPEC)
        assert wait_for(pending).verdicts()[0].clip_id == "episode 3 of session 7"
        assert model.cut == 2 and list(pending.result().valid) == [True, True]
        model.forget()
        assert model.cut == 3 and judge.tally.verdicts == 1, "only the episode that ended is judged"


def test_rollouts_in_which_no_episode_of_full_length_ends_are_refused_by_value_and_remedy() -> None:
    check_horizon(16, 16)
    with pytest.raises(ValueError, match=r"ppo\.num_steps is 15, .* 16 steps: .* at least that many"):
        check_horizon(15, 16)


def test_a_task_of_several_is_refused_because_no_judge_would_be_told_which_one_an_episode_is_of() -> None:
    check_agent(load_config("cpu", {"task": "push", "judge.kind": "embedded"}))
    with pytest.raises(ValueError, match=r"'all_tasks' is of one of .*push.*name one of them, or another reward"):
        check_agent(load_config("cpu", {"task": "all_tasks", "judge.kind": "embedded"}))


def test_a_rollout_without_an_ended_episode_pauses_instead_of_looking_like_a_failure() -> None:
    rollout = toy_rollout(toy_policy(), steps=3)
    none = np.zeros_like(rollout.valid_TN)
    cut = replace(rollout, terminated_TN=none, truncated_TN=none, valid_TN=~none)
    assert "none of the episodes in a rollout of 3 lock-steps (ppo.num_steps) was seen to end" in unjudged_reason(cut)
    one = none.copy()
    one[1, 0] = True
    assert unjudged_reason(replace(cut, truncated_TN=one)) == ""
    assert "1 of 1 episodes" in unjudged_reason(replace(cut, truncated_TN=one, valid_TN=~one))


def test_a_cut_episode_is_worth_what_the_critic_says_and_an_ended_one_its_verdict(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Environment 0 is cut, 1 reaches its time limit with a verdict of 0.25, 2 terminates with one of 0.75."""
    policy = toy_policy()
    base = toy_rollout(policy, steps=2)
    none = np.zeros_like(base.valid_TN)
    truncated, terminated, rewards = none.copy(), none.copy(), np.zeros(none.shape, np.float32)
    truncated[1, 1] = terminated[1, 2] = True
    rewards[1, 1:3] = 0.25, 0.75
    rollout = replace(base, rewards_TN=rewards, valid_TN=~none, terminated_TN=terminated, truncated_TN=truncated)
    monkeypatch.setattr(policy, "value", lambda features, states: torch.full((len(features),), 0.6))
    learner = PpoLearner(policy, toy_ppo(gamma=1.0, gae_lambda=1.0), seed=0)
    returns = learner._samples(tensors_of(terminate_at_episode_end(rollout), policy)).returns.reshape(none.shape)
    for column, worth in enumerate((0.6, 0.25, 0.75)):
        assert returns[:, column].tolist() == pytest.approx([worth] * 2)
    twice = learner._samples(tensors_of(rollout, policy)).returns.reshape(none.shape)
    assert float(twice[1, 1]) == pytest.approx(0.85), "the failure would have beaten the success"


def test_a_judge_that_is_down_leaves_the_last_step_without_a_reward_and_says_why(server: PickyServer) -> None:
    server.down = True
    with closing(JudgeService(settings(server), seed=0)) as judge:
        result = wait_for(EpisodeReward(judge).add(step(0, ended=(True, True)), SPEC)).result()
        assert not result.valid.any() and np.isnan(result.total).all()
        assert "environment 1: ERROR PLAN" in result.invalid_reason and "connection failed" in result.invalid_reason


@pytest.mark.parametrize("fails", ["audit", "judge"])
def test_whatever_goes_wrong_in_the_judging_is_a_last_step_without_a_reward(
    server: PickyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    with closing(JudgeService(settings(server), seed=0, audit=tmp_path)) as judge:
        if fails == "audit":
            (tmp_path / FOLDER).write_text("no folder: no picture can be stored")
        else:
            monkeypatch.setattr(judge, "_evaluate", lambda *_: {}["no such judge"])
        pending = wait_for(EpisodeReward(judge).add(step(0, ended=(True, False)), SPEC))
        result, error = pending.result(), {"audit": "NotADirectoryError: ", "judge": "KeyError: 'no such judge'"}[fails]
        assert list(result.valid) == [False, True] and np.isnan(result.total[0]) and result.total[1] == 0
        assert result.invalid_reason.startswith(f"environment 0: {error}")
        assert pending.problems()[0].startswith(error) and not pending.verdicts()


# Settings


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, r"set judge\.endpoints"),
        ({"endpoints": ["http://localhost/v1"]}, r"judge\.model"),
        ({"endpoints": ["http://localhost/v1"], "model": "m", "api_key_env": "sk-secret"}, "name of an environment"),
        ({"kind": "embedded", "folder": "/no/folder"}, "/no/folder"),
    ],
    ids=["nobody", "no_model", "a_key", "embedded_elsewhere"],
)
def test_settings_that_name_no_judge_are_refused_by_name_and_no_key_is_repeated(
    changes: dict[str, object], words: str
) -> None:
    with pytest.raises(ValueError, match=words) as error:
        check_judge(JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **changes}))
    assert "sk-secret" not in str(error.value)


def test_the_settings_of_loop_2_hold_the_judges_and_come_back_from_their_file(tmp_path: Path) -> None:
    words = judge_overrides("http://a/v1, http://b/v1", "judge", "KEY")
    config = load_video_config("smoke", {"rewards": {"agent": 1.0}, **words})
    assert config.judge.endpoints == ["http://a/v1", "http://b/v1"]
    (tmp_path / "config.yaml").write_text(dump_config(config))
    assert load_video_config(str(tmp_path / "config.yaml")) == config
    assert load_video_config("smoke").judge == load_config("smoke").judge


def test_a_named_judge_judges_whatever_judge_a_saved_configuration_has(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(dump_config(load_config("cpu", judge_overrides(str(tmp_path)))))
    by_server = load_config(str(file), judge_overrides("http://a/v1", "judge")).judge
    assert judge_name(by_server) == "judge at http://a/v1"
    by_default = load_config(str(file), judge_overrides("embedded")).judge
    assert judge_name(by_default) == "embedded judge of the task"


def test_the_command_refuses_an_agent_without_a_judge_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nobody = ["--reward", "agent", "--judge-model", "judge"]
    assert main(["train-video-model", "--preset", "smoke", *nobody, "--run-dir", str(tmp_path / "run")]) == 2
    assert "needs a judge" in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_the_command_refuses_an_embedded_judge_that_cannot_read_its_clips_before_a_model_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = [write_contexts(tmp_path / "contexts")]
    monkeypatch.setattr("wm_nodes.apps.train_video_model._data", lambda *given: (bags, bags))
    long = changed_judge(tmp_path / "long", lengths=(40, 50))
    embedded = ["--reward", "agent", "--judge", str(long), "--from-scratch"]
    run_dir = tmp_path / "run"
    assert main(["train-video-model", "--preset", "smoke", *embedded, "--run-dir", str(run_dir)]) == 2
    said = capsys.readouterr().err
    assert "cannot judge clips of 3 frames, 64 x 128 px" in said and "Name a server" in said
    assert not (run_dir / "video_model").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--reward", "agent", "--judge-model", "judge"], "needs a judge"),
        (["--judge-model", "judge"], "judge.model would change nothing without --reward agent"),
        (["--reward", "agent", *JUDGE, "--ppo.num_steps", "15"], "ppo.num_steps is 15"),
        (["--reward", "agent", *JUDGE, "--rubric", "nowhere"], "nowhere"),
        (["--reward", "agent", "--judge", "LONG"], "cannot judge clips of 17 frames, 64 x 128 px"),
        (["--reward", "agent", "--judge", "LONG"], "Name a server"),
        (["--reward", "agent", "--task", "pull_cube", "--from-scratch"], "no judge is shipped for task 'pull_cube'"),
    ],
    ids=["nobody", "judge_alone", "cut_off", "no_rubric", "length", "remedy", "other_task"],
)
def test_the_main_job_refuses_an_agent_that_could_not_judge_before_anything_is_made(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = tmp_path / "run"
    if "LONG" in options:
        options = [*options[:-1], str(changed_judge(tmp_path / "long", lengths=(40, 50)))]
    given = ["--preset", "smoke", "--ppo.num_steps", "16", "--run-dir", str(run_dir), *options]
    assert main(["train-policy", *given]) == 2
    assert words in capsys.readouterr().err and not run_dir.exists()


def test_launch_arguments_bring_the_agent_into_both_loops(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("{}")
    preset = tmp_path / "whole_episodes.yaml"
    preset.write_text("ppo: {num_steps: 16}")
    given = {"model_dir": str(tmp_path), "domain_id": "7"}
    judge = {"reward": "agent", "judge": "http://localhost:1/v1", "judge_model": "judge"}
    policies = {**given, "preset": str(preset)}
    numbers = count()

    def prepared(scenario: str, arguments: dict[str, str]) -> tuple[Graph, dict[str, str]]:
        return launch_arguments.prepare(scenario, {**arguments, "run_dir": str(tmp_path / f"run_{next(numbers)}")})

    graph, values = prepared("online_training", {**policies, **judge})
    assert graph.node("reward_evaluator").parameters["reward"] == "agent"
    assert graph.node("learner").parameters["join_timeout_s"] == 600
    topics = graph.node("recorder").parameters["topics"]
    assert isinstance(topics, list) and "reward/verdict" in topics
    assert load_config(f"{values['run_dir']}/config.yaml").judge.endpoints == ["http://localhost:1/v1"]
    clips = {**given, "preset": "smoke", "video_model_dir": "m", "context_bags": "b"}
    shipped, long = str(shipped_model("push_cube")), str(changed_judge(tmp_path / "long", lengths=(40, 50)))
    for name, folder in (("embedded", ""), (shipped, shipped)):
        _, values = prepared("world_model_rl", {**clips, "reward": "agent", "judge": name})
        here = load_video_config(f"{values['run_dir']}/config.yaml").judge
        assert (here.kind, here.folder, here.endpoints) == ("embedded", folder, [])
    _, values = prepared("world_model_rl", {**clips, **judge})
    config = load_video_config(f"{values['run_dir']}/config.yaml")
    assert config.rewards == {"agent": 1.0} and config.judge.model == "judge"
    for scenario, arguments, load in (
        ("online_training", policies, load_config), ("world_model_rl", clips, load_video_config),
    ):
        _, values = prepared(scenario, {**arguments, "reward": "agent"})
        judge_of_run = load(f"{values['run_dir']}/config.yaml").judge
        assert judge_of_run.kind == "embedded", "nobody is named: the one that needs nothing"
    refusals = [
        ("online_training", {**policies, "reward": "agent", "judge_model": "judge"}, "needs a judge"),
        ("online_training", {**policies, "reward": "agent", "judge": long}, "cannot judge clips of .* 64 x 128"),
        ("online_training", {**policies, "judge": "http://localhost:1/v1"}, "would change nothing without"),
        ("online_training", {**policies, **judge, "preset": "smoke"}, r"ppo\.num_steps is 6"),
        ("world_model_rl", {**clips, "reward": "rule"}, "is of policies"),
        ("world_model_rl", {**clips, "reward": "agent", "judge_model": "judge"}, "needs a judge"),
    ]
    for scenario, arguments, words in refusals:
        with pytest.raises(GraphError, match=words):
            prepared(scenario, arguments)
