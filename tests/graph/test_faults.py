"""What happens when nodes die, messages are missed, or settings are wrong."""

import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from graph.harness import Graph, Probe, shm_files, wait_until
from left_over import remove_left_over

from wm_msgs.action import Train
from wm_msgs.msg import Credit, TransitionBatch
from wm_nodes.core.errors import WireError
from wm_nodes.launching.runner import NEW_S
from wm_nodes.training.weights import save_weights

pytestmark = [pytest.mark.graph, pytest.mark.alone]
HELD_UP_S = 2.8


@pytest.mark.kills
def test_each_killed_node_is_reported_within_5_s_and_training_goes_on_after_its_restart(
    graph: Graph, probe: Probe
) -> None:
    book = probe.links()
    graph.start_training_nodes()
    client = probe.action(Train, "train")
    updates: list[Any] = []
    handle = probe.send(client, Train.Goal(updates=100000), updates.append)
    restart = {
        "/wm/policy": graph.start_policy, "/wm/environment": graph.start_environment,
        "/wm/reward_evaluator": graph.start_reward,
    }
    for name, start in restart.items():
        count = len(updates)
        wait_until(f"an update before {name} dies", lambda c=count: len(updates) > c)
        probe.seen_errors.clear()
        graph.kill(name)
        probe.wait_for_loss("/wm/learner", name)
        count = len(updates)
        graph.restart(start, book, name, "/wm/learner", *restart)
        wait_until(f"an update after {name} is back", lambda c=count: len(updates) > c)
    graph.kill("/wm/learner")
    graph.processes["/wm/policy"].send_signal(signal.SIGSTOP)  # the middleware may hold a node up as long after a kill
    time.sleep(HELD_UP_S)
    graph.processes["/wm/policy"].send_signal(signal.SIGCONT)
    probe.wait_for_loss("/wm/policy", "/wm/learner")
    probe.diagnostics.pop("/wm/learner")
    graph.restart(graph.start_learner, book, "/wm/learner", *restart)
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=1)))
    assert result.termination_reason == Train.Result.FINISHED
    assert result.updates > 1
    del handle


@pytest.mark.kills
def test_training_ends_with_peer_lost_when_a_node_does_not_come_back(graph: Graph, probe: Probe) -> None:
    graph.start_training_nodes(recovery_timeout_s=8.0)
    names = ("environment", "policy", "reward_evaluator", "learner")
    wait_until("active nodes", lambda: all(probe.value(f"/wm/{name}", "state") == "active" for name in names))
    updates: list[Any] = []
    handle = probe.send(probe.action(Train, "train"), Train.Goal(updates=100000), updates.append)
    wait_until("an update", lambda: updates)
    graph.kill("/wm/policy")
    result = probe.finish(handle)
    assert result.termination_reason == Train.Result.PEER_LOST
    assert "/wm/policy" in result.message


@pytest.mark.kills
def test_a_policy_that_is_back_before_it_was_missed_gets_its_rollout_again(graph: Graph, probe: Probe) -> None:
    book = probe.links()
    graph.start_training_nodes(peer_timeout_s=60.0)
    updates: list[Any] = []
    handle = probe.send(probe.action(Train, "train"), Train.Goal(updates=100000), updates.append)
    wait_until("an update", lambda: updates)
    graph.kill("/wm/policy")
    count = len(updates)
    graph.restart(graph.start_policy, book, "/wm/policy", "/wm/environment", "/wm/reward_evaluator", "/wm/learner")
    wait_until("an update by the new policy process", lambda: len(updates) > count + 1)
    assert not probe.losses("/wm/learner", "/wm/policy")
    assert "/wm/policy was stopped or restarted" in graph.log("/wm/learner")
    del handle


@pytest.mark.kills
def test_cleaning_takes_a_dead_process_s_memory_and_no_lock_of_a_living_one(graph: Graph, probe: Probe) -> None:
    def locks(node: str) -> set[Path]:
        files = Path(f"/proc/{graph.processes[node].pid}/fd").iterdir()
        return {path for path in map(Path.resolve, files) if path.name.endswith("_el")}

    graph.start_reward()
    graph.start_policy()
    for name in ("reward_evaluator", "policy"):
        wait_until("an active node", lambda n=name: probe.value(f"/wm/{n}", "state") == "active")
    dead, living = locks("/wm/reward_evaluator"), locks("/wm/policy")
    time.sleep(NEW_S)
    graph.kill("/wm/reward_evaluator")
    remove_left_over()
    segments = {path for path in dead if "port" not in path.name}
    assert segments and not any(path.exists() for path in segments)
    assert living and all(path.exists() for path in living), "a second listener may take the port now"


def test_reported_gaps_equal_the_true_gaps_of_a_flood(graph: Graph, probe: Probe) -> None:
    graph.start_reward()
    credits = probe.listen("flow/credit")
    publisher = probe.publisher("env/transition")
    wait_until("matching", lambda: publisher.get_subscription_count())
    left_out = {seq for seq in range(1, 2000) if seq % 7 == 0 or 500 <= seq < 600}
    for seq in range(2000):
        if seq not in left_out:
            publisher.publish(TransitionBatch(session=9, seq=seq))
    publisher.publish(TransitionBatch(session=9, seq=2000))
    wait_until("the last message", lambda: credits and credits[-1].received_seq == 2000)
    assert credits[-1].lost_total == len(left_out)
    lost = str(len(left_out))
    wait_until("the count", lambda: probe.value("/wm/reward_evaluator", "lost env/transition") == lost)


def test_a_consumer_without_credit_holds_the_environment_up_until_it_is_dropped(graph: Graph, probe: Probe) -> None:
    from graph.test_environment import Client

    graph.start_environment()
    client = Client(probe)
    start = client.reset()
    credit = probe.publisher("flow/credit")
    wait_until("matching", lambda: credit.get_subscription_count())
    credit.publish(Credit(consumer="/wm/slow", topic="env/transition", stream_session=client.session, granted_seq=0))
    wait_until("the credit", lambda: "/wm/slow" in (probe.value("/wm/environment", "credit_consumers") or ""))
    began = time.monotonic()
    refusals: list[str] = []

    def stepped() -> bool:
        try:
            client.step(client.command(start.step_id + 1))
        except WireError as error:
            refusals.append(str(error))
            return False
        return True

    assert not stepped()
    wait_until("the drop", stepped)
    assert time.monotonic() - began > 3.0
    assert all("/wm/slow" in text for text in refusals)
    wait_until("the report", lambda: probe.value("/wm/environment", "dropped_consumers") == "1")


@pytest.mark.kills
@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"backend": "gazebo"}, "must be one of world_model, video_model, environment, evaluation; got 'gazebo'"),
        ({"num_env": 3}, "unknown parameter 'num_env'; did you mean 'num_envs'?"),
        (
            {"qos_overrides./wm/env/image.publisher.depth": 2},
            "'qos_overrides./wm/env/image.publisher.depth' would change nothing: QoS is one table for graph and bags; "
            "change the topic's row in wm_nodes/recording/topics.py",
        ),
        ({"num_envs": 0}, "num_envs must be at least 1; got 0"),
        ({"backend": "environment", "environment__factory": "nowhere:make"}, "No module named 'nowhere'"),
        ({"backend": "world_model"}, "model_dir"),
        ({"config_file": "/nowhere.yaml"}, "'/nowhere.yaml' does not exist"),
        (
            {"backend": "environment", "environment__factory": "toy:make_environment_of_large_images", "num_envs": 257},
            "num_envs=257 images of 256 x 512 px make one env/image of 106954752 bytes, more than the 100663296 that "
            "DDS carries in time; lower num_envs or simulation.image_size",
        ),
        ({"executor": "fast"}, "executor must be one of events, single, multi; got 'fast'"),
    ],
)
def test_a_wrong_setting_ends_the_node_with_one_line_that_names_it(
    graph: Graph, params: dict[str, Any], words: str
) -> None:
    assert graph.start("environment", **params).wait(60) == 1
    log = graph.log("/wm/environment")
    assert words in log
    assert "Traceback" not in log


@pytest.mark.kills
@pytest.mark.parametrize("node", ["policy", "learner"])
def test_weights_of_another_architecture_end_the_node_with_one_line_that_names_the_file(
    graph: Graph, node: str
) -> None:
    file = graph.folder / "other.safetensors"
    save_weights(torch.nn.Linear(2, 2), file)
    assert graph.start(node, policy__factory="toy:make_policy", initial_policy=file).wait(60) == 1
    log = graph.log(f"/wm/{node}")
    assert f"initial_policy {file}: " in log and "weights of another architecture: " in log
    assert "use the configuration it was made by" in log and "Traceback" not in log


@pytest.mark.kills
def test_a_cut_checkpoint_ends_the_learner_with_one_line_that_names_it(graph: Graph) -> None:
    file = graph.folder / "checkpoints" / "learner.json"
    file.parent.mkdir()
    file.write_text('{"progress": {')
    assert graph.start_learner().wait(60) == 1
    log = graph.log("/wm/learner")
    assert f"{file} cannot be read" in log and "put a copy of it back, or begin anew in another run folder" in log
    assert "Traceback" not in log


def test_the_largest_image_is_not_refused(graph: Graph, probe: Probe) -> None:
    graph.start_environment("toy:make_environment_of_large_images", num_envs=256)
    wait_until("the node", lambda: probe.value("/wm/environment", "state") == "active")


@pytest.mark.slow
def test_fifty_start_stop_cycles_leave_no_shared_memory(graph: Graph) -> None:
    """An environment with all its topics and services. Not counted: Fast DDS's ports from 7000 on, which all processes
    and domains of the host take in turns and which stay there, as many as were ever in use at once; and what another
    process has mapped: on such a port a process of a neighbouring test is heard, too, and its segment mapped."""
    cycle = (
        "import os, re, signal\n"
        "from shm_maps import mapped, processes\n"
        "from wm_nodes.nodes.environment_node import EnvironmentNode\n"
        "from wm_nodes.ros.spin import run_node\n"
        "ever = set()\n"
        "class Cycle(EnvironmentNode):\n"
        "    def activate(self):\n"
        "        super().activate()\n"
        "        ever.update(mapped('self'))\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "for _ in range(50):\n"
        "    assert run_node(Cycle) == 0\n"
        "    others = set().union(*(mapped(name) for name in processes() if name != str(os.getpid())))\n"
        "    own = [path for path in ever - others if not re.search('fastrtps_port7[0-3]..$', path)]\n"
        "    left = [os.stat(path).st_size for path in own if os.path.exists(path)]\n"
        "    print('left', len(own), len(left), sum(left), flush=True)\n"
    )
    before = shm_files()
    given = {
        "config_file": graph.config_file(environment__factory="toy:make_environment"), "run_dir": graph.folder,
        "backend": "environment", "num_envs": 4,
    }
    parameters = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-c", cycle, "--ros-args", *parameters]
    done = subprocess.run(command, env=graph.environment(), capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    ports = range(7400 + 250 * graph.domain, 7400 + 250 * (graph.domain + 1))
    assert not {name for name in shm_files() - before if name in {f"fastrtps_port{port}" for port in ports}}
    said = (line.split() for line in done.stdout.splitlines())  # Fast DDS warns there, too, on a busy host
    rows = [[*map(int, words[1:])] for words in said if words[:1] == ["left"]]
    assert len(rows) == 50, done.stdout
    seen, files, sizes = zip(*rows, strict=True)
    assert seen[-1] >= 50, "the shared memory of the cycles was not seen"
    assert files[-1] - files[4] <= 2, f"shared-memory files after each cycle: {files}"
    assert sizes[-1] - sizes[4] <= 2**20, f"bytes of shared memory after each cycle: {sizes}"
