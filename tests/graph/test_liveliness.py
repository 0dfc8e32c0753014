"""A silent node is reported once, with what its process does, and so is its return; one that computes is not."""

import re
import signal
import time
from typing import Any

import pytest
from graph.harness import Graph, Probe, wait_until
from graph.toy import COMPUTING_S

from wm_msgs.action import Train

pytestmark = [pytest.mark.graph, pytest.mark.alone]
STOPPED_S = 12.0


def test_a_stopped_environment_is_one_warning_and_one_recovery_for_each_node(graph: Graph, probe: Probe) -> None:
    graph.start_training_nodes()
    updates: list[Any] = []
    running = probe.send(probe.action(Train, "train"), Train.Goal(updates=100000), updates.append)
    wait_until("an update", lambda: updates)
    environment = graph.processes["/wm/environment"]
    environment.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    environment.send_signal(signal.SIGCONT)
    count = len(updates)
    wait_until("training that goes on", lambda: len(updates) > count)
    for node in ("/wm/learner", "/wm/policy", "/wm/reward_evaluator"):
        told = [line for line in graph.log(node).splitlines() if re.search("ERROR|WARN|is back", line)]
        about = [line for line in told if "/wm/environment" in line and "rollout" not in line]
        lost = f"process {environment.pid} is stopped (kill -CONT continues it); restart it"
        assert [line.endswith(lost) for line in about] == [True, False], told
        assert "/wm/environment is back after" in about[1]
        assert len(told) <= 6, told
    wait_until("an all-clear", lambda: "lost" not in probe.diagnostics["/wm/learner"].message)
    del running


def test_an_environment_that_computes_for_twice_the_timeout_is_not_reported(graph: Graph, probe: Probe) -> None:
    graph.start_environment("toy:make_computing_environment")
    graph.start_policy()
    graph.start_reward()
    graph.start_learner()
    updates: list[Any] = []
    running = probe.send(probe.action(Train, "train"), Train.Goal(updates=100000), updates.append)
    began = time.monotonic()
    wait_until("an update after it", lambda: updates and time.monotonic() - began > COMPUTING_S)
    for node in ("/wm/learner", "/wm/policy", "/wm/reward_evaluator"):
        assert "lost" not in graph.log(node) and "silent" not in graph.log(node)
    del running
