"""A launch file's graph as a user starts it with ROS 2's Python alone, and the main job as a user starts it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from graph.harness import wait_until

PROGRAM = "import sys; from wm_nodes.launching.runner import main; sys.exit(main(sys.argv[1], sys.argv[2:]))"
TRAIN_POLICY = "import sys; from wm_nodes.apps.cli import main; sys.exit(main(['train-policy', *sys.argv[1:]]))"


@contextmanager
def launched(scenario: str, given: Sequence[str], log: Path) -> Iterator[None]:
    """The graph of a launch file while it is ready; ended by Ctrl-C, with exit code 0."""
    with log.open("wb") as output:
        starter = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, scenario, *given], stdout=output, stderr=output, env=os.environ.copy()
        )
        try:
            wait_until(
                "the graph",
                lambda: starter.poll() is not None or "ready; Ctrl-C stops" in log.read_text(encoding="utf-8"), 120,
            )
            assert starter.poll() is None, log.read_text(encoding="utf-8")
            yield
        finally:
            starter.send_signal(signal.SIGINT)
            code = starter.wait(60)
    assert code == 0, log.read_text(encoding="utf-8")


def train_policy(arguments: list[str], domain: int) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "COLUMNS": "160"}
    command = [sys.executable, "-c", TRAIN_POLICY, "--domain-id", str(domain), *arguments]
    return subprocess.run(command, env=environment, capture_output=True, encoding="utf-8", timeout=600, check=False)
