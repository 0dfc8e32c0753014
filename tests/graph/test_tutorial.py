"""docs/tutorial.md does what it says: its commands run as they are written, and print what it quotes."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

BASH, TEXT = (re.compile(rf"^```{kind}\n(.+?)^```", re.MULTILINE | re.DOTALL) for kind in ("bash", "text"))
NUMBER = re.compile(r"[\d.]+")

pytestmark = [pytest.mark.graph, pytest.mark.slow]


def normal(text: str) -> str:
    """Without numbers, line ends and frames of tables, which differ by machine and by width."""
    return " ".join(re.sub(r"[│┃━┏┓┡┩└┘┴─╇┳]", " ", NUMBER.sub("#", text)).split())


def test_the_tutorial_runs_as_written_and_prints_what_it_quotes(
    repository: Path, tmp_path: Path, ros_domain: int
) -> None:
    tutorial = (repository / "wm_nodes" / "docs" / "tutorial.md").read_text(encoding="utf-8")
    (tmp_path / "wm_nodes").symlink_to(repository / "wm_nodes")
    environment = {
        **os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "COLUMNS": "160",
        "PYTHONPATH": str(repository / "wm_nodes"),
    }
    commands = BASH.findall(tutorial)
    assert len(commands) >= 5
    said = ""
    for command in commands:
        done = subprocess.run(
            ["bash", "-eu", "-c", command], cwd=tmp_path, env=environment, capture_output=True, encoding="utf-8",
            timeout=600, check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        said += normal(done.stdout) + " "
    quotes = [line for block in TEXT.findall(tutorial) for line in block.splitlines() if line.strip()]
    assert quotes
    assert not [line for line in quotes if normal(line) not in said], said
    judged = json.loads((tmp_path / "runs" / "tutorial" / "model" / "model" / "acceptance.json").read_text())
    assert not [row["name"] for row in judged["criteria"] if normal(row["name"]) not in normal(tutorial)]
