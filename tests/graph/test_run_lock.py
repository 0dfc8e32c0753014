"""A run folder has one writer, also where two graphs never meet; a launch goes on from its folder alone."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.launched import PROGRAM, launched
from run_holders import holder

from wm_msgs.action import Train
from wm_nodes.training.run_lock import NAME
from wm_nodes.training.run_record import read_record

pytestmark = pytest.mark.graph


def start_learner(graph: Graph, namespace: str = "/wm") -> int:
    """Start a learner, and return its process once the folder is its own, or its exit code."""
    process = graph.start("learner", namespace, policy__factory="toy:make_policy")
    lock = graph.folder / NAME
    wait_until("lock", lambda: process.poll() is not None or (lock.exists() and f'"process": {process.pid},' in
                                                             lock.read_text()))
    return process.pid if process.poll() is None else process.wait(0)


@pytest.mark.kills
def test_a_learner_started_by_hand_holds_its_folder_until_it_ends(graph: Graph) -> None:
    with holder(graph.folder) as other:
        assert start_learner(graph) == 1
        log = graph.log("/wm/learner")
        assert f"configure failed: run folder {graph.folder} is in use by process {other.pid} on" in log
        assert log.count("\n") == 1 and not (graph.folder / "policies").exists()
    first = start_learner(graph)
    assert start_learner(graph, "/other") == 1
    assert f"is in use by process {first} on" in graph.log("/other/learner")
    graph.kill("/wm/learner")
    second = start_learner(graph)
    assert second > 1 and f"taking over the lock of process {first} on" in graph.log("/wm/learner")
    graph.processes["/wm/learner"].send_signal(signal.SIGINT)
    assert graph.processes["/wm/learner"].wait(20) == 0
    assert not (graph.folder / NAME).exists()


def refused(command: list[str], domain: int) -> str:
    """What a command says that ends with an error, in one line."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode in (1, 2) and (done.stdout + done.stderr).count("\n") == 1, done.stdout + done.stderr
    return done.stderr


@pytest.mark.slow
def test_one_graph_at_a_time_writes_into_a_folder_and_a_launch_goes_on_from_it_alone(
    domain: int, probe: Probe, tmp_path: Path
) -> None:
    """Two updates with a stop between them give the weights of two in one go."""
    starter = [sys.executable, "-c", PROGRAM, "online_training"]
    begun = ["preset:=smoke", "simulator:=false", "seed:=5", "num_envs:=6"]
    folders = tmp_path / "stopped", tmp_path / "whole"
    own = f"domain_id:={domain}"
    for folder, parts in ((folders[0], (1, 1)), (folders[1], (2,))):
        given = begun
        for updates in parts:
            with launched("online_training", [*given, f"run_dir:={folder}", own], tmp_path / "starter.log"):
                if updates == 2:
                    with own_domain() as other:
                        text = refused([*starter, "task:=reach", f"run_dir:={folder}"], other)
                        assert text.startswith(f"error: run folder {folder} is in use by process ")
                        node = ["-m", "wm_nodes.nodes.learner_node", "--ros-args", "-p", f"run_dir:={folder}"]
                        assert f"{folder} is in use by process " in refused([sys.executable, *node], other)
                result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=updates)))
                assert result.termination_reason == Train.Result.FINISHED, result.message
            given = []
        assert result.updates == 2 and not (folder / NAME).exists()
    record = read_record(folders[0])
    assert record is not None and record.preset == "smoke" and record.settings["seed"] == 5
    assert record.options["online_training"]["num_envs"] == "6"
    files = [folder / "policies" / "policy_000003.safetensors" for folder in folders]
    assert files[0].read_bytes() == files[1].read_bytes()
    with own_domain() as other:
        text = refused([*starter, "seed:=6", "num_envs:=6", f"run_dir:={folders[0]}"], other)
        assert "seed is 5 in this run, 6 is given" in text and "begin another run folder" in text
