"""Processes that hold a run folder, or try to."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

HOLD = """
import sys, time
from pathlib import Path
from wm_nodes.training.run_lock import RunFolderInUseError, RunLock
while len(sys.argv) > 2 and not Path(sys.argv[2]).exists():
    time.sleep(0.0005)
try:
    with RunLock(Path(sys.argv[1])):
        print("held", flush=True)
        sys.stdin.read()
except RunFolderInUseError as error:
    print(error, flush=True)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def start_holder(folder: Path, gate: Path | None = None) -> subprocess.Popen[str]:
    """A process that takes the folder, when the gate is there, says "held" or why not, and ends with its stdin."""
    command = [sys.executable, "-c", HOLD, str(folder), *([str(gate)] if gate else [])]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, encoding="utf-8")


@contextmanager
def holder(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the folder."""
    process = start_holder(folder)
    try:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
    finally:
        process.communicate()
