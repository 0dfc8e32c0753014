"""--help is there at once, with Python alone, and says what the parsers say."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from wm_nodes.apps.help import FOLDER, asked_page
from wm_nodes.apps.help.__main__ import COLUMNS, pages

SCENARIO = "evaluate: Measure a policy in the simulator"


def test_the_pages_are_those_of_the_parsers(monkeypatch: pytest.MonkeyPatch) -> None:
    """By their words, as versions of argparse break lines at other places."""
    monkeypatch.setenv("COLUMNS", COLUMNS)
    kept = {file.name: file.read_text(encoding="utf-8").split() for file in FOLDER.glob("*.txt")}
    assert {name: text.split() for name, text in pages().items()} == kept, "write them: python -m wm_nodes.apps.help"


@pytest.mark.parametrize(
    ("words", "first"),
    [
        ("wm.py", "usage: python3 launch_scripts/wm.py VERB [options]"),
        ("wm.py --help", "usage: python3 launch_scripts/wm.py VERB [options]"),
        ("wm.py benchmark -h", "usage: python3 launch_scripts/wm.py VERB [options]"),
        ("wm.py train-policy --seed 1 --help", "usage: python3 launch_scripts/wm.py train-policy [-h] [--preset"),
        ("wm.py audit verify log --help", "usage: python3 launch_scripts/wm.py audit verify [-h]"),
        ("wm.py benchmark clips -h", "usage: python3 launch_scripts/wm.py benchmark clips [-h]"),
        ("online_rl.py --help", "usage: python3 launch_scripts/online_rl.py [-h] [--preset"),
        ("run_tests.py --help", "Every check of the repository"),
        ("setup --help", "usage: setup [-h] [--check]"),
        ("evaluate.launch.py --help", SCENARIO),
        ("evaluate.launch.py task:=push --show-args", SCENARIO),
    ],
)
def test_help_needs_no_environment_and_sets_none_up(words: str, first: str, repository: Path, tmp_path: Path) -> None:
    script, *options = words.split()
    command = [sys.executable, "-S", "-E", str(repository / "launch_scripts" / script), *options]
    environment = {"PATH": os.environ["PATH"], "WM_VENV": str(tmp_path / "venv"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, encoding="utf-8", check=False)
    assert (done.returncode, done.stderr, os.listdir(tmp_path)) == (0, "", [])
    assert done.stdout.startswith(first)


def test_help_of_an_option_that_stands_behind_the_word_is_of_the_verb() -> None:
    assert (asked_page("audit", ["--help", "verify"], "wm audit") or "").startswith("usage: wm audit [-h] COMMAND")
    assert asked_page("audit", ["verify", "log"], "wm audit") is None
