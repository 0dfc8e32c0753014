"""What a launched process says goes to the terminal and into its file."""

import io
import os
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from wm_nodes.launching.graph import Graph, NodeSpec
from wm_nodes.launching.process import NodeProcess
from wm_nodes.launching.runner import Runner

NUM_LINES = 3000
"""More than a pipe and its buffers hold."""


@pytest.fixture
def talker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> NodeSpec:
    """Says NUM_LINES lines."""
    (tmp_path / "talker.py").write_text(f"for n in range({NUM_LINES}): print('line', n, 'of a long text' * 5)\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    return NodeSpec("talker", "talker")


def closed_terminal() -> io.TextIOWrapper:
    """Standard output whose reader has gone, as behind `| head`."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


@pytest.mark.parametrize("open_", [True, False])
def test_a_terminal_that_has_gone_takes_nothing_from_the_log_file(
    tmp_path: Path, talker: NodeSpec, open_: bool
) -> None:
    log = io.StringIO() if open_ else closed_terminal()
    process = NodeProcess(talker, sys.executable, dict(os.environ), log=log, colour=None, file=tmp_path / "talker.log")
    process.start()
    assert process.wait(60) == 0
    process.close()
    lines = (tmp_path / "talker.log").read_text().splitlines()
    assert [int(line.split()[1]) for line in lines] == list(range(NUM_LINES))
    assert process.last_output_line().startswith(f"line {NUM_LINES - 1} ")
    if isinstance(log, io.StringIO):
        assert log.getvalue().splitlines() == [f"[wm/talker] {line}" for line in lines]
    with suppress(BrokenPipeError):
        log.close()


def test_a_starter_whose_terminal_has_gone_goes_on() -> None:
    log = closed_terminal()
    Runner(Graph("talk", ()), log=log)._say("starting")
    with suppress(BrokenPipeError):
        log.close()
