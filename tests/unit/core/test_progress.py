"""A progress bar is one on a terminal only; in a file it is a line now and then."""

import fcntl
import io
import os
import pty
import struct
import subprocess
import sys
import termios

import pytest

from wm_nodes.core import progress
from wm_nodes.core.progress import tqdm

STEPS = "from wm_nodes.core.progress import tqdm; [0 for _ in tqdm(range(3), desc='steps')]"


def test_a_file_gets_first_and_last_line_of_a_quick_bar_and_nothing_that_moves_a_cursor() -> None:
    file = io.StringIO()
    for _ in tqdm(range(400), desc="outer", file=file):
        for _ in tqdm(range(2), desc="inner", file=file, leave=False):
            pass
    lines = [line for line in file.getvalue().split("\n") if line.startswith("outer")]
    assert "0/400" in lines[0] and "400/400" in lines[-1] and len(lines) == 2
    assert not {"\r", "\x1b"} & {*file.getvalue()} and max(map(len, lines)) < 120


def test_what_is_said_behind_a_bar_makes_no_further_lines_of_a_file() -> None:
    file = io.StringIO()
    with tqdm(total=100, file=file) as bar:
        for step in range(100):
            bar.update()
            bar.set_postfix(success=step)
            bar.set_postfix_str(f"step {step}")
    assert file.getvalue().count("\n") == 2 and "step 99" in file.getvalue()


def test_a_slow_bar_shows_every_so_often_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LINE_S", 0.0)
    file = io.StringIO()
    with tqdm(total=3, file=file, unit="clip") as bar:
        bar.update()
        bar.set_postfix(reward=0.5)
    assert [f"{n}/3" in file.getvalue() for n in range(3)] == [True, True, False] and "reward=0.5" in file.getvalue()


def test_a_log_of_a_process_has_no_carriage_returns_and_a_terminal_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TQDM_DISABLE", raising=False)  # main() of the command sets it, in other tests
    done = subprocess.run([sys.executable, "-c", STEPS], capture_output=True, check=True)
    assert b"\r" not in done.stderr and done.stderr.count(b"\n") == 2
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    subprocess.run([sys.executable, "-c", STEPS], stderr=theirs, check=True)
    assert os.read(ours, 1_000_000).startswith(b"\rsteps:")
    os.close(theirs)  # before, there would be nothing left to read
