"""A launch file as a user starts it with ROS 2's Python alone: nothing but its own defaults and the shipped model."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from graph.harness import Probe, wait_until

from wm_msgs.action import Train
from wm_nodes.recording import read_rollouts

PROGRAM = "import sys; from wm_nodes.ros.runner import main; sys.exit(main('online_training', sys.argv[1:]))"

pytestmark = pytest.mark.graph


@pytest.mark.slow
def test_the_training_graph_starts_from_its_defaults_trains_on_request_and_ends_with_ctrl_c(
    domain: int, probe: Probe, tmp_path: Path
) -> None:
    given = ["preset:=smoke", "simulator:=false", f"run_dir:={tmp_path}", f"domain_id:={domain}"]
    log = tmp_path / "starter.log"
    with log.open("wb") as output:
        starter = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *given], stdout=output, stderr=output, env=os.environ.copy()
        )
        try:
            wait_until("the graph", lambda: starter.poll() is not None or "ready; Ctrl-C stops" in log.read_text(), 120)
            assert starter.poll() is None, log.read_text()
            result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=1)))
            assert (result.termination_reason, result.updates) == (Train.Result.FINISHED, 1), result.message
        finally:
            starter.send_signal(signal.SIGINT)
            code = starter.wait(60)
    assert code == 0, log.read_text()
    assert len(list(read_rollouts(tmp_path / "bags" / "online_training"))) == 1
