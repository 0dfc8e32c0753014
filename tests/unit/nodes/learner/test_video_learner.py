"""The learner of loop 2 before it is a node."""

import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from wm_nodes.nodes.video_learner_node import main


def test_several_processes_under_torchrun_are_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr("sys.argv", ["video_learner_node"])
    assert main() == 1
    error = "error: this learner is one process, got WORLD_SIZE 2; start it without torchrun\n"
    assert capsys.readouterr().err == error
