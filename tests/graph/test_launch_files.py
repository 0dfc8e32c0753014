"""A launch file as a user starts it with ROS 2's Python alone: nothing but its own defaults and the shipped model."""

from pathlib import Path

import pytest
from graph.harness import Probe
from graph.launched import launched

from wm_msgs.action import Train
from wm_nodes.recording import read_rollouts

pytestmark = pytest.mark.graph


@pytest.mark.slow
def test_the_training_graph_starts_from_its_defaults_trains_on_request_and_ends_with_ctrl_c(
    domain: int, probe: Probe, tmp_path: Path
) -> None:
    given = ["preset:=smoke", "simulator:=false", f"run_dir:={tmp_path}", f"domain_id:={domain}"]
    with launched("online_training", given, tmp_path / "starter.log"):
        result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=1)))
        assert (result.termination_reason, result.updates) == (Train.Result.FINISHED, 1), result.message
    assert len(list(read_rollouts(tmp_path / "bags" / "online_training"))) == 1
