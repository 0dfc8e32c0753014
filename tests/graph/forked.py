"""Nodes of the graph tests, which start about two hundred of them, fork from one server of the test process."""

import atexit
import functools
import os
import signal
import subprocess
import sys
from concurrent.futures import Future
from pathlib import Path

from wm_nodes.launching.fork_server import ForkServer

PRELOADED = (
    *(
        f"wm_nodes.nodes.{name}_node"
        for name in (
            "clip_evaluator", "environment", "evaluation", "learner", "player", "policy", "recorder",
            "reward_evaluator", "video_learner", "video_model",
        )
    ),
    "wm_nodes.environments.maniskill.environment",
)


class ForkedNode:
    """What the tests need of subprocess.Popen."""

    def __init__(self, pid: int, end: Future[int], args: list[str]) -> None:
        self.pid, self.args, self._end = pid, args, end

    @property
    def returncode(self) -> int | None:
        return self._end.result() if self._end.done() else None

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        try:
            return self._end.result(timeout)
        except TimeoutError:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0) from None

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def fork_node(arguments: list[str], environment: dict[str, str], log: Path) -> ForkedNode:
    """Run `python -m *arguments`, its output appended to `log`."""
    with log.open("ab") as output:
        return ForkedNode(*_server().start(arguments, environment, output.fileno()), arguments)


@functools.cache
def _server() -> ForkServer:
    server = ForkServer(sys.executable, PRELOADED, {**os.environ, "OMP_NUM_THREADS": "1"})
    atexit.register(server.close)
    return server
