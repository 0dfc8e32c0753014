"""The packages as `colcon build` installs them, for users of ROS 2 from apt; wm_msgs is built so by every set-up."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from wm_nodes.config.shipped import PRETRAINED

SHOWN = """
import json, sys
from pathlib import Path
import wm_nodes
from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import PRETRAINED
from wm_nodes.judge.agent.rubric import load_rubric
load_config("smoke"), load_rubric("robot")
files = sorted(str(path.relative_to(PRETRAINED)) for path in PRETRAINED.rglob("*") if path.is_file())
print(json.dumps([str(Path(wm_nodes.__file__).parent), files]))
"""


@pytest.mark.slow
def test_the_packages_build_and_what_is_installed_is_whole(repository: Path, tmp_path: Path) -> None:
    """Without symbolic links, so that nothing of the checkout is used afterwards."""
    install = tmp_path / "install"
    prefix = dict.fromkeys(("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"), sys.prefix)
    build = [sys.executable, "-m", "colcon", "--log-base", str(tmp_path / "log"), "build"]
    build += ["--paths", "src/wm_nodes", "src/wm_bringup", "--install-base", str(install)]
    build += ["--build-base", str(tmp_path / "build"), "--cmake-args", f"-DPython3_EXECUTABLE={sys.executable}"]
    done = subprocess.run(
        build, cwd=repository / "ros2_ws", env={**os.environ, **prefix}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "2 packages finished" in done.stdout, done.stdout + done.stderr
    ours, installed = repository / "launch_scripts", install / "wm_bringup" / "share" / "wm_bringup" / "launch"
    assert {path.name for path in installed.iterdir()} == {path.name for path in ours.glob("*.launch.py")}
    package = next((install / "wm_nodes" / "lib").glob("python3.*/site-packages"))
    environment = {**os.environ, "PYTHONPATH": str(package)}
    shown = subprocess.run(
        [sys.executable, "-c", SHOWN], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert shown.returncode == 0, shown.stderr
    imported, files = json.loads(shown.stdout)
    assert imported == str(package / "wm_nodes")
    assert files == sorted(str(path.relative_to(PRETRAINED)) for path in PRETRAINED.rglob("*") if path.is_file())
    nodes = sorted((install / "wm_nodes" / "lib" / "wm_nodes").iterdir())
    assert len(nodes) >= 10 and all(os.access(node, os.X_OK) for node in nodes)


def test_a_workspace_has_three_packages_and_leaves_tf2_msgs_to_ros_2(repository: Path) -> None:
    command = [sys.executable, "-m", "colcon", "--log-base", os.devnull, "list", "--names-only"]
    done = subprocess.run(command, cwd=repository / "ros2_ws", capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["wm_bringup", "wm_msgs", "wm_nodes"]
