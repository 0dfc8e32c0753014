"""Nodes when something breaks inside them: the model, the renderer, a callback, the disk, the clock, a lifecycle."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from graph import toy
from graph.harness import Graph, Probe, wait_until
from graph.test_environment import Client
from graph.test_training import train
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from wm_msgs.action import Train
from wm_msgs.msg import EpisodeEvent, ErrorCode
from wm_msgs.srv import ResetBatch
from wm_nodes.ros import calls
from wm_nodes.ros.wire import ResetCommand, WireError

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
        request = ChangeState.Request(transition=Transition(id=transition))
        assert probe.call(ChangeState, f"{node}/change_state", request).success, f"{node}: transition {transition}"


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
    assert graph.start("environment", backend="maniskill").wait(90) == 1
    log = graph.log("/wm/environment")
    assert "no renderer at cuda:77" in log
    assert "Traceback" not in log


@pytest.mark.kills
def test_an_unexpected_exception_in_a_callback_ends_the_node_in_order(graph: Graph, probe: Probe) -> None:
    states, events = probe.listen("run/state"), probe.listen("episode")
    process = graph.start_environment("toy:make_environment_with_bad_goals")
    client = Client(probe)
    wait_until("matching", lambda: probe.node.count_publishers("/wm/episode"))
    client.reset()
    wait_until("START", lambda: events)
    with pytest.raises(AssertionError, match="no answer"):
        probe.call(ResetBatch, "env/reset", calls.reset_request(ResetCommand()), timeout_s=5)
    assert process.wait(20) == 1
    wait_until("END", lambda: any(e.kind == EpisodeEvent.KIND_END for e in events))
    wait_until("FAILED", lambda: any(s.state == s.FAILED for s in states))
    assert "ZeroDivisionError" in graph.log("/wm/environment")


def test_transitions_without_images_are_declared_invalid_although_the_simulated_clock_stands(
    graph: Graph, probe: Probe
) -> None:
    rewards, summaries = probe.listen("reward"), probe.listen("reward/summary")
    graph.start_reward(use_sim_time=True, image_wait_s=0.2)
    graph.start_environment()
    client = Client(probe)
    wait_until("the evaluator", lambda: probe.value("/wm/reward_evaluator", "state") == "active")
    wait_until("matching", lambda: probe.node.count_subscribers("/wm/env/transition") >= 1)
    start = client.reset()
    client.step(client.command(start.step_id + 1))
    wait_until("a reward", lambda: rewards)
    wait_until("a summary", lambda: summaries)


@pytest.mark.kills
def test_a_full_disk_stops_recording_with_one_error_and_the_node_lives_on(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    client = Client(probe)
    process = graph.start("recorder", bag_uri="bags/full")
    wait_until("recording", lambda: "recording to" in graph.log("/wm/recorder"))
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))

    def failed() -> bool:
        start = client.reset()
        client.step(client.command(start.step_id + 1))
        return "recording stopped" in graph.log("/wm/recorder")

    wait_until("the error", failed, 30)
    assert process.poll() is None
    wait_until("ERROR", lambda: any("recording stopped" in text for text in probe.seen_errors["/wm/recorder"]))
    assert "Traceback" not in graph.log("/wm/recorder")


def test_the_main_job_without_a_renderer_ends_with_one_line(tmp_path: Path) -> None:
    code = "import sys; from wm_nodes.main_job import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "--preset", "smoke", "--run-dir", str(tmp_path / "run")]
    command += ["--set", "simulation.render_device=cuda:77"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "no renderer at cuda:77" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr
