"""--help is there at once, with Python alone, and says what the parsers say."""

import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from wm_nodes.apps.cli import VERBS
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


def test_in_a_fresh_copy_every_verb_explains_itself_within_a_second_and_begins_no_set_up(
    repository: Path, tmp_path: Path
) -> None:
    copy, left_out = tmp_path / "copy", shutil.ignore_patterns("__pycache__", "pretrained", "*.json")
    for name in ("launch_scripts", "wm_nodes/wm_nodes", "requirements", "msgs_schema"):
        shutil.copytree(repository / name, copy / name, ignore=left_out)
    before = sorted(copy.rglob("*"))

    def cpu_s() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    for verb in VERBS:
        command = [sys.executable, "-B", "-S", "-E", "launch_scripts/wm.py", *verb.split(), "--help"]
        began = cpu_s()
        done = subprocess.run(command, cwd=copy, capture_output=True, encoding="utf-8", check=False)
        assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("usage: "), verb
        assert cpu_s() - began < 1, verb
    assert sorted(copy.rglob("*")) == before


def test_the_page_of_a_verb_that_takes_settings_explains_each_of_them() -> None:
    for verb, name, about in (
        ("train-policy", "--ppo.num_steps 16", "Lock-steps per update."),
        ("train-video-model", "--iterations 30", "Buffers to train on."),
        ("judge-clips", "--judge.concurrency ", "Clips judged at the same time."),
    ):
        page = asked_page(verb, ["--help"], f"wm {verb}") or ""
        assert f"\n  {name}" in page and about in page.partition(f"\n  {name}")[2][:120]
    assert "--ppo." not in (asked_page("audit", ["--help"], "wm audit") or "")
