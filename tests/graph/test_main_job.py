"""The main job as a user starts it, smallest preset: simulator, world model, seven node processes, report."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from wm_nodes.recording import read_episodes
from wm_nodes.reports import read_summary

PROGRAM = "import sys; from wm_nodes.main_job import main; sys.exit(main(sys.argv[1:]))"
RATES = ("real_before", "real_after", "imagined_before", "imagined_after")


def start(arguments: list[str], domain: int) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "COLUMNS": "160"}
    command = [sys.executable, "-c", PROGRAM, "--domain-id", str(domain), *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)


@pytest.mark.slow
def test_the_main_job_runs_end_to_end_and_leaves_summary_report_and_bag(ros_domain: int, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    done = start(["--preset", "smoke", "--force", "--run-dir", str(run_dir)], ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = read_summary(run_dir)
    assert (summary["task"], summary["preset"], summary["seed"]) == ("push_cube", "smoke", 0)
    assert all(0 <= summary[name]["successes"] <= summary[name]["episodes"] for name in RATES)
    assert summary["real_before"]["episodes"] == summary["real_after"]["episodes"] == 4
    assert summary["imagined_steps_per_s"] > 0
    assert list(Path(summary["bag"]).glob("*.mcap"))
    played = [episode.behaviour for episode in read_episodes(Path(summary["bag"]), namespace="/wm/sim")]
    assert played.count("before") >= 4 and played.count("after") >= 4
    assert "data:image/png;base64" in (run_dir / "report.html").read_text()
    assert json.loads((run_dir / "gate.json").read_text())["criteria"]


def test_a_wrong_setting_ends_with_one_clear_line(ros_domain: int, tmp_path: Path) -> None:
    done = start(["--set", "ppo.updates=many", "--run-dir", str(tmp_path)], ros_domain)
    assert done.returncode == 2
    assert "ppo.updates" in done.stdout and "many" in done.stdout and "Traceback" not in done.stdout + done.stderr
