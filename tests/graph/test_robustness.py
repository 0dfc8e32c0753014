"""Nodes when something breaks inside them: the model, the renderer, a callback, the disk, the clock, a lifecycle."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import rclpy
from graph import toy
from graph.harness import MATCH_S, Graph, Probe, wait_until
from graph.test_environment import Client
from graph.test_training import train
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from wm_msgs.action import Train
from wm_msgs.msg import EpisodeEvent, ErrorCode
from wm_msgs.srv import ResetBatch, StartRecording, StopRecording
from wm_nodes.apps.cli import main
from wm_nodes.core.errors import WireError
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.training_run import restore
from wm_nodes.recording import BagError, recover
from wm_nodes.ros import calls
from wm_nodes.ros.qos import topic
from wm_nodes.ros.wire import ResetCommand

pytestmark = pytest.mark.graph

CYCLE = (
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
)


def cycle(probe: Probe, node: str) -> None:
    """deactivate, clean up, configure and activate a node through its lifecycle service."""
    for transition in CYCLE:
        change(probe, node, transition)


def change(probe: Probe, node: str, transition: int) -> None:
    request = ChangeState.Request(transition=Transition(id=transition))
    assert probe.call(ChangeState, f"{node}/change_state", request).success, f"{node}: transition {transition}"


@pytest.mark.slow
def test_an_environment_cleaned_up_and_configured_again_has_a_new_session_and_trains_the_same_weights(
    graph: Graph, probe: Probe
) -> None:
    graph.start_training_nodes()
    before = Client(probe).session
    assert train(probe, updates=1).termination_reason == Train.Result.FINISHED
    for node in ("environment", "reward_evaluator"):
        cycle(probe, node)
    assert Client(probe).session != before
    assert train(probe, updates=1).termination_reason == Train.Result.FINISHED
    toy.assert_trained_in_one_process(graph.folder / "policies" / "policy_000003.safetensors", updates=2)


@pytest.mark.slow
def test_an_environment_that_is_deactivated_in_a_rollout_and_activated_again_does_not_end_the_training(
    graph: Graph, probe: Probe
) -> None:
    graph.start_environment()
    graph.start("policy", policy__factory="toy:make_slow_policy", await_nodes=["environment", "reward_evaluator"])
    graph.start_reward()
    graph.start_learner()
    steps = probe.listen("env/transition")
    wait_until("active", lambda: probe.value("/wm/environment", "state") == "active")
    cycle(probe, "environment")  # so that its service is known when the rollout runs
    handle = probe.send(probe.action(Train, "train"), Train.Goal(updates=1))
    wait_until("steps", lambda: len(steps) > 2)
    change(probe, "environment", Transition.TRANSITION_DEACTIVATE)
    wait_until("a repeated rollout", lambda: probe.value("/wm/learner", "repeated_rollouts"))
    change(probe, "environment", Transition.TRANSITION_ACTIVATE)
    assert probe.finish(handle).termination_reason == Train.Result.FINISHED
    toy.assert_trained_in_one_process(graph.folder / "policies" / "policy_000002.safetensors", updates=1)


def test_a_node_says_at_once_that_it_has_stopped_and_that_its_topics_are_new(graph: Graph, probe: Probe) -> None:
    heard = probe.listen("run/links")
    graph.start_environment()
    wait_until("active", lambda: any(links.active for links in heard))
    cycle(probe, "environment")
    first = next(i for i, links in enumerate(heard) if links.active)
    wait_until("a new session", lambda: heard[-1].session != heard[first].session)
    said = [(links.session, links.active) for links in heard[first:]]
    told = [one for one, before in zip(said, [None, *said], strict=False) if one != before]
    assert [active for _, active in told][:2] == [True, False] and told[-1][1]


@pytest.mark.slow
def test_a_reader_that_takes_nothing_of_ten_thousand_events_ends_no_environment(graph: Graph, probe: Probe) -> None:
    num_envs = 3340  # a start each, and then an end and a start each: 10,020 events
    graph.start_environment(num_envs=num_envs)
    client = Client(probe)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=graph.domain)
    deaf, row = rclpy.create_node("deaf", namespace="/wm", context=context), topic("episode")
    deaf.create_subscription(row.type, row.name, lambda message: None, row.qos)
    wait_until("matching", lambda: deaf.count_publishers("/wm/episode"))
    time.sleep(MATCH_S)
    still = np.zeros((num_envs, 3), np.float32)
    start = client.reset()
    again = client.step(client.command(start.step_id + 1, still, reset_mask=np.ones(num_envs, bool)))
    wait_until("the count", lambda: int(probe.value("/wm/environment", "unsent episode") or 0) > 0)
    assert client.step(client.command(again.step_id + 1, still)).step_id == again.step_id + 1
    deaf.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    ("factory", "code", "words"),
    [
        ("toy:make_nan_environment", ErrorCode.NAN_MODEL, "NaN in environments [0]"),
        ("toy:make_failing_environment", ErrorCode.INTERNAL, "RuntimeError: broken motor"),
    ],
)
def test_a_failing_environment_answers_with_a_code_reports_an_error_and_lives_on(
    graph: Graph, probe: Probe, factory: str, code: int, words: str
) -> None:
    graph.start_environment(factory)
    client = Client(probe)
    events = probe.listen("episode")
    wait_until("matching", lambda: probe.node.count_publishers("/wm/episode"))
    start = client.reset()
    with pytest.raises(WireError) as refused:
        client.step(client.command(start.step_id + 1))
    assert refused.value.code == code
    assert words in str(refused.value)
    wait_until("END", lambda: any(e.termination_reason == EpisodeEvent.REASON_ERROR for e in events))
    wait_until("ERROR in diagnostics", lambda: any(words in text for text in probe.seen_errors["/wm/environment"]))
    after = client.reset()
    np.testing.assert_array_equal(client.step(client.command(after.step_id + 1)).states, after.states)


@pytest.mark.kills
def test_a_node_without_a_renderer_ends_with_one_line(graph: Graph) -> None:
    graph.config = graph.config.model_copy(
        update={"simulation": graph.config.simulation.model_copy(update={"render_device": "cuda:77"})}
    )
    graph = Graph(graph.domain, graph.folder, graph.config)
    assert graph.start("environment", backend="environment").wait(90) == 1
    log = graph.log("/wm/environment")
    assert "no renderer at cuda:77" in log
    assert "Traceback" not in log


def test_an_environment_that_fails_in_a_reset_says_so_in_the_answer_and_can_be_reset_again(
    graph: Graph, probe: Probe
) -> None:
    graph.start_environment("toy:make_environment_with_bad_goals")
    client = Client(probe)
    client.reset()
    answer = probe.call(ResetBatch, "env/reset", calls.reset_request(ResetCommand()))
    assert (answer.error_code, "ZeroDivisionError: no goal" in answer.message) == (ErrorCode.INTERNAL, True)
    client.reset()


@pytest.mark.slow
def test_an_unexpected_exception_in_a_timer_ends_the_node_in_order(graph: Graph, probe: Probe) -> None:
    states = probe.listen("run/state")
    program = [sys.executable, "-m", "failing_node", "--ros-args", "-r", "__ns:=/wm"]
    ended = subprocess.run(
        program, env=graph.environment(), capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 1 and "ZeroDivisionError" in ended.stderr
    wait_until("FAILED", lambda: any(s.state == s.FAILED for s in states))


@pytest.mark.slow
def test_transitions_without_images_are_declared_invalid_although_the_simulated_clock_stands(
    graph: Graph, probe: Probe
) -> None:
    rewards, summaries = probe.listen("reward"), probe.listen("reward/summary")
    graph.start_reward(use_sim_time=True, image_wait_s=0.2)
    graph.start_environment()
    client = Client(probe)
    wait_until("the evaluator", lambda: probe.value("/wm/reward_evaluator", "state") == "active")
    last = client.reset().step_id

    def rewarded() -> bool:
        """Steps until the environment has matched the evaluator; the pause is longer than image_wait_s."""
        nonlocal last
        last += 1
        client.step(client.command(last))
        time.sleep(0.5)
        return bool(rewards)

    wait_until("a reward", rewarded)
    wait_until("a summary", lambda: summaries)


def full_disk(process: subprocess.Popen[bytes], limit_bytes: float = resource.RLIM_INFINITY) -> None:
    """No file of the process may grow beyond the limit any more: writes fail with OSError, as on a full disk."""
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (int(limit_bytes), resource.RLIM_INFINITY))


@pytest.mark.slow
def test_a_full_disk_stops_recording_with_one_error_nothing_flushed_is_lost_and_the_node_lives_on(
    graph: Graph, probe: Probe
) -> None:
    graph.start_environment()
    client = Client(probe)
    process = graph.start("recorder", bag_uri="bags/full")
    wait_until("recording", lambda: "recording to" in graph.log("/wm/recorder"))
    partial = graph.folder / "bags" / "full.partial"

    def recorded() -> bool:
        """Steps until the environment has matched the recorder, which flushes four times a second."""
        start = client.reset()
        client.step(client.command(start.step_id + 1))
        time.sleep(0.5)
        return _count(partial, "env/transition") >= 2

    wait_until("transitions on the disk", recorded)
    full_disk(process, max(_size(partial), 10_000))

    def failed() -> bool:
        with suppress(WireError):  # the environment waits for the recorder
            start = client.reset()
            client.step(client.command(start.step_id + 1))
        return "recording stopped" in graph.log("/wm/recorder")

    wait_until("the error", failed)
    assert process.poll() is None
    wait_until("ERROR", lambda: any("recording stopped" in text for text in probe.seen_errors["/wm/recorder"]))
    log = graph.log("/wm/recorder")
    assert "free disk space" in log
    assert log.count("recording stopped") == 1
    assert "Traceback" not in log
    assert f"the bag is unfinished: {partial}" in log and "is complete" not in log
    assert not (graph.folder / "bags" / "full").exists()
    assert not (graph.folder / "bags.json").exists()
    assert _count(partial, "env/transition") >= 2
    stop = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
    assert stop.error_code == ErrorCode.NOT_ACTIVE
    full_disk(process)
    again = probe.call(StartRecording, "recorder/start", StartRecording.Request(bag_uri="bags/again"))
    assert (again.error_code, again.message) == (ErrorCode.OK, "")
    client.reset()
    wait_until("messages", lambda: _count(graph.folder / "bags" / "again.partial", "env/transition") >= 1)
    assert probe.call(StopRecording, "recorder/stop", StopRecording.Request()).messages >= 1
    assert [row["bag"] for row in json.loads((graph.folder / "bags.json").read_text())] == ["bags/again"]


def _size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.glob("*.mcap"))


def _count(folder: Path, topic: str) -> int:
    """Messages of a topic that a recovery of the folder brings back, complete or not."""
    with tempfile.TemporaryDirectory() as scratch:
        try:
            return recover(folder, output=Path(scratch) / "bag").topics.get(f"/wm/{topic}", 0)
        except BagError:
            return 0


@pytest.mark.slow
def test_a_full_disk_ends_training_as_failed_with_one_error_and_the_last_checkpoint_loads(
    graph: Graph, probe: Probe
) -> None:
    graph.start_environment()
    graph.start_policy(await_nodes=["environment", "reward_evaluator", "learner"])
    graph.start_reward()
    learner = graph.start_learner()
    assert train(probe, updates=1).termination_reason == Train.Result.FINISHED
    checkpoint = graph.folder / "checkpoints" / "learner.json"
    complete = checkpoint.read_bytes()
    full_disk(learner, 10_000)
    failed = train(probe, updates=1)
    assert failed.termination_reason == Train.Result.FAILED
    assert "cannot write" in failed.message and "free some space" in failed.message
    assert learner.poll() is None
    assert "Traceback" not in graph.log("/wm/learner")
    assert checkpoint.read_bytes() == complete
    toy.assert_trained_in_one_process(graph.folder / "policies" / "policy_000002.safetensors", updates=1)
    full_disk(learner)
    policy = toy.make_policy(graph.config)
    assert restore(policy, PpoLearner(policy, graph.config.ppo, seed=graph.config.seed), checkpoint).version == 2
    again = train(probe, updates=1)
    assert (again.termination_reason, again.policy_version) == (Train.Result.FINISHED, 4)
    toy.assert_trained_in_one_process(graph.folder / "policies" / "policy_000004.safetensors", updates=3)


@pytest.mark.slow
def test_the_main_job_without_a_renderer_ends_with_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    given = ["--preset", "smoke", "--run-dir", str(tmp_path / "run"), "--simulation.render_device", "cuda:77"]
    assert main(["train-policy", *given]) == 2
    said = capfd.readouterr()
    assert "no renderer at cuda:77" in said.err and "Traceback" not in said.out + said.err
