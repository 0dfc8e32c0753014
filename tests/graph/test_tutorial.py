"""docs/tutorial.md does what it says: its commands run as they are written, and print what it quotes."""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = (ROOT / "wm_nodes" / "docs" / "tutorial.md").read_text(encoding="utf-8")
PATTERN = r"^```{}\n(.+?)^```"
COMMANDS, QUOTED = (re.findall(PATTERN.format(kind), TUTORIAL, re.M | re.S) for kind in ("bash", "text"))
QUOTES = [line for block in QUOTED for line in block.splitlines() if line.strip()]

pytestmark = [pytest.mark.graph, pytest.mark.slow]


def normal(text: str) -> str:
    """Without numbers, line ends and frames of tables, which differ by machine and by width."""
    return " ".join(re.sub(r"[│┃━┏┓┡┩└┘┴─╇┳]", " ", re.sub(r"[\d.]+", "#", text)).split())


@dataclass
class Reader:
    """Somebody who types the commands, one after the other."""

    folder: Path
    """Where."""
    printed: list[str] = field(default_factory=list)
    """What each command so far has printed."""

    def type_up_to(self, number: int) -> None:
        environment = {
            **os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "COLUMNS": "160",
            "PYTHONPATH": str(ROOT / "wm_nodes"),
        }
        for command in COMMANDS[len(self.printed) : number + 1]:
            done = subprocess.run(
                ["bash", "-eu", "-c", command], cwd=self.folder, env=environment, capture_output=True, encoding="utf-8",
                check=False,
            )
            assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
            self.printed.append(done.stdout)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    folder = tmp_path_factory.mktemp("checkout")
    (folder / "wm_nodes").symlink_to(ROOT / "wm_nodes")
    return Reader(folder)


@pytest.mark.parametrize("number", range(len(COMMANDS)))
def test_a_command_of_the_tutorial_runs_as_it_is_written(reader: Reader, number: int, ros_domain: int) -> None:
    reader.type_up_to(number)


def test_the_commands_print_what_the_tutorial_quotes(reader: Reader, ros_domain: int) -> None:
    reader.type_up_to(len(COMMANDS) - 1)
    printed = normal(" ".join(reader.printed))
    assert QUOTES and not [line for line in QUOTES if normal(line) not in printed], printed
    judged = json.loads((reader.folder / "runs" / "tutorial" / "model" / "model" / "acceptance.json").read_text())
    assert not [row["name"] for row in judged["criteria"] if normal(row["name"]) not in normal(TUTORIAL)]
