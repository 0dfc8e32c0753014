"""Loop 2 when its nodes die, are stopped, get garbage, or find no room: one clear end, and the next goal goes on from
there. Whatever happened, the weights are those of the loop that nothing disturbed."""

import contextlib
import hashlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from action_msgs.msg import GoalStatus
from deadlines import within
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.test_robustness import full_disk
from graph.video_loop import NAMES, VideoLoop, settings
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from wm_msgs.action import EvaluateClips, GenerateClips, TrainVideo
from wm_msgs.msg import PolicyVersion
from wm_nodes.launching.scenarios import VIDEO_TOPICS
from wm_nodes.recording import recover
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.recorded_buffers import read_clips
from wm_nodes.video_rl.training_run import CHECKPOINT

pytestmark = [pytest.mark.graph, pytest.mark.alone]

ACTIONS = ((EvaluateClips, "clips/evaluate"), (GenerateClips, "video/generate"), (TrainVideo, "video/train"))
ENDS = (GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_ABORTED)
TRIES = 5
ANSWER_S = 1.0
"""A cancel is answered within this time."""
LOST_S = 12.0
"""A lost peer ends the goal within this time: peer_timeout_s, two heartbeats, a crowded machine."""


@contextlib.contextmanager
def running_loop(folder: Path) -> Iterator[VideoLoop]:
    """The running loop after one iteration; seed 2 draws the blind context in the first one."""
    with own_domain() as domain:
        graph, probe = Graph(domain, folder), Probe(domain)
        try:
            loop = VideoLoop(graph, probe, settings(**{"seed": 2, "grpo.micro_batch": 1}))
            loop.start("video_model", version_timeout_s=1.0)
            loop.start("clip_evaluator")
            loop.start("video_learner")
            loop.wait_active()
            loop.assert_undisturbed(loop.train(1))
            yield loop
        finally:
            probe.close()
            graph.stop()


@pytest.fixture(scope="module")
def loops() -> Iterator[tuple[contextlib.ExitStack, list[VideoLoop]]]:
    """What ends the module's loop, and that loop where one runs."""
    with contextlib.ExitStack() as stack:
        yield stack, []


@pytest.fixture
def loop(
    loops: tuple[contextlib.ExitStack, list[VideoLoop]], request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[VideoLoop]:
    """The module's loop. One in which a test failed ends, and the next test starts another."""
    stack, running = loops
    if not running:
        running.append(stack.enter_context(running_loop(tmp_path_factory.mktemp("loop") / "run")))
    failed = request.session.testsfailed
    yield running[0]
    if request.session.testsfailed > failed:
        running.clear()
        stack.close()


def test_clips_without_reward_are_left_out_and_counted(loop: VideoLoop) -> None:
    result = loop.train(1)
    loop.assert_undisturbed(result)
    assert loop.local.invalid[result.iterations] > 0
    expected = str(loop.local.invalid[result.iterations])
    wait_until("the count", lambda: loop.probe.value("/wm/learner", "invalid_rewards") == expected)


def _buffer(loop: VideoLoop, name: str, data: bytes) -> tuple[str, str]:
    """Write a file into the run folder; return its path there and its sha256."""
    (loop.graph.folder / name).write_bytes(data)
    return name, hashlib.sha256(data).hexdigest()


def _judge(cut: int | None, sha256: str = "") -> Callable[[VideoLoop], EvaluateClips.Goal]:
    def goal(loop: VideoLoop) -> EvaluateClips.Goal:
        uri, found = _buffer(loop, "garbage.safetensors", loop.local.buffer(0, 0).to_bytes()[:cut])
        return EvaluateClips.Goal(buffer_uri=uri, sha256=sha256 or found)

    return goal


def _pipe(make: Callable[[str], Any]) -> Callable[[VideoLoop], Any]:
    """A goal that names a FIFO of the run folder, which nobody writes."""

    def goal(loop: VideoLoop) -> Any:
        path = loop.graph.folder / "pipe"
        if not path.exists():
            os.mkfifo(path)
        return make(path.name)

    return goal


def _announced(uri: str) -> Callable[[VideoLoop], GenerateClips.Goal]:
    """A goal for a version that somebody announced with this file."""

    def goal(loop: VideoLoop) -> GenerateClips.Goal:
        publisher = loop.probe.publisher("video/version")
        wait_until("matching", publisher.get_subscription_count)
        publisher.publish(PolicyVersion(version=77, uri=uri, sha256="0" * 64))
        return GenerateClips.Goal(policy_version=77)

    return goal


def _train_on(make: Callable[[VideoLoop], Any]) -> Callable[[VideoLoop], TrainVideo.Goal]:
    def goal(loop: VideoLoop) -> TrainVideo.Goal:
        uri, _ = _buffer(loop, "garbage.safetensors", make(loop).to_bytes())
        return TrainVideo.Goal(from_buffers=[uri])

    return goal


def _without_rewards(loop: VideoLoop) -> Any:
    done = loop.train(0).iterations
    buffer = loop.local.buffer(done, done)
    return buffer.with_rewards({"total": torch.full((len(buffer),), torch.nan)})


def _of_other_settings(loop: VideoLoop) -> Any:
    rollout = loop.config.rollout
    other = rollout.with_values(sampler=rollout.sampler.with_values(eta=0.2))
    return loop.local.buffer(0, 0, loop.config.with_values(rollout=other))


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        (lambda _: EvaluateClips.Goal(buffer_uri="nowhere.safetensors"), "nowhere.safetensors: No such file"),
        (_judge(None, sha256="0" * 64), "is not the announced buffer (sha256"),
        (_judge(10_000), "these 10000 bytes are no complete rollout buffer"),
        (lambda _: GenerateClips.Goal(policy_version=99), "asked for version 99, video/version announced "),
        (lambda _: TrainVideo.Goal(), "iterations is 0 and from_buffers is empty"),
        (lambda _: TrainVideo.Goal(from_buffers=["nowhere.safetensors"]), "nowhere.safetensors: No such file"),
        (_train_on(_of_other_settings), "the buffer was sampled with sampler settings"),
        (_train_on(lambda loop: loop.local.buffer(0, 0)), "the buffer comes from version 0, the learner is at "),
        (_train_on(_without_rewards), "nothing to learn from: 6 of 6 rewards are invalid"),
        (lambda _: EvaluateClips.Goal(buffer_uri="/dev/zero"), "'/dev/zero' lies outside of the run folder and of"),
        (_pipe(lambda uri: EvaluateClips.Goal(buffer_uri=uri)), "is no regular file; name a file that holds"),
        (_announced("/dev/zero"), "'/dev/zero' lies outside of the run folder and of allowed_dirs"),
        (_pipe(lambda uri: TrainVideo.Goal(from_buffers=[uri])), "is no regular file; name a file that holds"),
        (lambda _: TrainVideo.Goal(from_buffers=["../absent"]), "'../absent' lies outside of the run folder and of"),
    ],
    ids=["judge_missing", "judge_other", "judge_cut", "sample_unknown", "train_nothing", "train_missing",
         "train_other_settings", "train_stale", "train_without_rewards", "judge_outside", "judge_pipe",
         "sample_outside", "train_pipe", "train_outside"],
)
def test_a_goal_of_garbage_fails_by_name_and_changes_nothing(loop: VideoLoop, goal: Any, words: str) -> None:
    probe, message = loop.probe, goal(loop)
    before = loop.train(0)
    kind, name = next(action for action in ACTIONS if isinstance(message, action[0].Goal))
    result = probe.finish(probe.send(probe.action(kind, name), message))
    assert result.termination_reason == type(result).FAILED
    assert words in result.message
    after = loop.train(0)
    assert (after.policy_version, after.iterations) == (before.policy_version, before.iterations)
    assert loop.newest(after) == loop.local.weights(after.iterations)
    for node in loop.graph.processes:
        assert "Traceback" not in loop.graph.log(node)


def test_an_iteration_that_is_sampled_again_keeps_its_buffer_whatever_else_is_kept(loop: VideoLoop) -> None:
    mine = loop.graph.folder / "buffers" / "buffer_best.safetensors"
    mine.write_bytes(b"mine")
    done = loop.train(4)
    goal = GenerateClips.Goal(iteration=0, policy_version=done.policy_version)
    result = loop.probe.finish(loop.probe.send(loop.probe.action(GenerateClips, "video/generate"), goal))
    assert result.termination_reason == GenerateClips.Result.FINISHED
    assert hashlib.sha256((loop.graph.folder / result.buffer_uri).read_bytes()).hexdigest() == result.sha256
    assert mine.read_bytes() == b"mine" and len(list(mine.parent.iterdir())) == 1 + 4


def test_cancel_is_answered_at_once_while_the_video_model_hangs_and_leaves_no_goal_with_it(loop: VideoLoop) -> None:
    """The model gets the goal and its end when it goes on; where others keep the machine busy it may have sampled by
    then, or the learner may not have asked it yet, and all is done again."""
    model, clips = loop.graph.processes["/wm/video_model"], loop.probe.listen("clips")
    goals = loop.probe.goals("video/generate")
    wait_until("matching", lambda: loop.probe.node.count_publishers("/wm/clips"))
    loop.assert_undisturbed(loop.train(1))
    wait_until("its clips and its goal", lambda: clips and goals)
    for left in reversed(range(TRIES)):
        known, count = len(goals), len(clips)
        model.send_signal(signal.SIGSTOP)
        try:
            handle = loop.send(1)
            time.sleep(min(within(0.5), 1.5))  # the learner has asked for clips by now, and does not miss the model yet
            began = time.monotonic()
            result = loop.cancel(handle)
            assert time.monotonic() - began < within(ANSWER_S)
        finally:
            model.send_signal(signal.SIGCONT)
        assert result.termination_reason == TrainVideo.Result.CANCELED
        with contextlib.suppress(AssertionError):
            wait_until("the goal's end", lambda: len(goals) > known and [*goals.values()][-1] in ENDS, within(5.0))  # noqa: B023
            if [*goals.values()][-1] == GoalStatus.STATUS_CANCELED:
                break
        assert left, f"the cancelled goal was sampled all the same: {goals}"
    assert len(clips) == count
    loop.assert_undisturbed(loop.train(1))


def repeated(buffer: RolloutBuffer, times: int) -> RolloutBuffer:
    """The videos of a buffer, `times` times."""
    index = torch.arange(len(buffer)).repeat(times)
    return replace(
        buffer, rollout=buffer.rollout.rows(index), condition=buffer.condition.rows(index),
        group_ids=buffer.group_ids[index], sample_ids=buffer.sample_ids[index],
        rewards={name: values[index] for name, values in buffer.rewards.items()},
    )


def test_cancel_is_answered_at_once_during_an_update_and_takes_it_back(loop: VideoLoop) -> None:
    done = loop.train(1)
    small = loop.local.buffer(done.iterations, done.iterations)
    uri, _ = _buffer(loop, "large.safetensors", repeated(small, 150).to_bytes())
    handle = loop.send(from_buffers=[uri])
    time.sleep(1.5)  # it has read the file, and trains for many times as long
    began = time.monotonic()
    result = loop.cancel(handle)
    assert time.monotonic() - began < within(ANSWER_S)
    assert result.termination_reason == TrainVideo.Result.CANCELED
    assert result.iterations == done.iterations
    loop.assert_undisturbed(loop.train(1))


def test_a_full_disk_ends_training_as_failed_with_one_error_and_the_last_checkpoint_loads(loop: VideoLoop) -> None:
    learner, before = loop.graph.processes["/wm/video_learner"], loop.train(1)
    checkpoint = loop.graph.folder / CHECKPOINT
    complete, errors = checkpoint.read_bytes(), loop.graph.log("/wm/video_learner").count("video/train failed")
    full_disk(learner, 10_000)
    failed = loop.train(2)
    assert failed.termination_reason == TrainVideo.Result.FAILED
    assert "cannot write" in failed.message and "free some space" in failed.message
    assert checkpoint.read_bytes() == complete
    log = loop.graph.log("/wm/video_learner")
    assert log.count("video/train failed") == errors + 1 and "Traceback" not in log
    network, config = load_video_folder(loop.model).network, loop.config
    loaded = GrpoLearner(network, config.grpo, config.rollout, seed=config.seed)
    loaded.load(checkpoint)
    assert loaded.iterations == before.iterations
    full_disk(learner)
    again = loop.train(1)
    assert again.iterations == before.iterations + 2, "the training that could not be written was made again"
    loop.assert_undisturbed(again)


def _until_training(loop: VideoLoop) -> Any:
    """Send a long goal; return its handle after the first buffer."""
    fed = list[Any]()
    handle = loop.send(100000, fed.append)
    wait_until("a trained buffer", lambda: fed)
    return handle


def _assert_lost(loop: VideoLoop, handle: Any, *words: str) -> None:
    result = loop.probe.finish(handle, within(LOST_S))
    assert result.termination_reason == TrainVideo.Result.PEER_LOST
    assert all(word in result.message for word in words), result.message
    assert loop.newest(result) == loop.local.weights(result.iterations)


@pytest.mark.kills
def test_a_killed_video_model_ends_training_by_its_name_and_the_next_goal_finds_it_again(loop: VideoLoop) -> None:
    handle = _until_training(loop)
    loop.graph.kill("/wm/video_model")
    _assert_lost(loop, handle, "/wm/video_model", "silent")
    loop.restart("video_model")
    loop.assert_undisturbed(loop.train(1))


@pytest.mark.kills
def test_an_evaluator_that_is_killed_and_back_before_it_was_missed_ends_training_by_its_name(loop: VideoLoop) -> None:
    patient = Parameter("peer_timeout_s", value=60.0).to_parameter_msg()
    loop.probe.call(SetParameters, "learner/set_parameters", SetParameters.Request(parameters=[patient]))
    handle = _until_training(loop)
    loop.graph.processes["/wm/clip_evaluator"].send_signal(signal.SIGSTOP)
    time.sleep(within(1.0))  # the learner has asked it for scores by now
    loop.graph.kill("/wm/clip_evaluator")
    loop.restart("clip_evaluator")
    _assert_lost(loop, handle, "/wm/reward_evaluator", "restarted")
    loop.assert_undisturbed(loop.train(1))


@pytest.mark.kills
def test_a_killed_learner_is_reported_and_goes_on_exactly_from_its_checkpoint(loop: VideoLoop) -> None:
    _until_training(loop)
    loop.probe.seen_errors.clear()
    loop.graph.kill("/wm/video_learner")
    lost = "/wm/learner is lost"
    wait_until("a report", lambda: any(lost in text for text in loop.probe.seen_errors["/wm/video_model"]))
    loop.restart("video_learner")
    loop.assert_undisturbed(loop.train(2))


@pytest.mark.kills
def test_a_killed_recorder_disturbs_no_training_and_records_again_beside_what_it_left(loop: VideoLoop) -> None:
    topics = "[" + ",".join(VIDEO_TOPICS) + "]"
    bags = loop.graph.folder / "bags"
    awaited = Parameter("await_nodes", value=["recorder"]).to_parameter_msg()
    loop.probe.call(SetParameters, "learner/set_parameters", SetParameters.Request(parameters=[awaited]))
    for _ in range(2):
        start = partial(loop.graph.start, "recorder", bag_uri="bags/run", topics=topics, min_free_mib=16)
        loop.graph.restart(start, loop.links, "/wm/recorder", *NAMES.values())
        loop.assert_undisturbed(loop.train(1))
        time.sleep(2.0)  # a kill may cost the recorder's last second
        loop.graph.kill("/wm/recorder")
    first, second = (list(read_clips(recover(bags / name).bag)) for name in ("run.partial", "run_1.partial"))
    assert [clips.iteration + 1 for clips in first] == [clips.iteration for clips in second]


def test_a_peer_that_is_stopped_ends_training_by_its_name(loop: VideoLoop) -> None:
    handle = _until_training(loop)
    loop.stop("video_model")
    _assert_lost(loop, handle, "/wm/video_model", "stopped")
