"""Node processes that fork from an interpreter in which torch, rclpy, ManiSkill and the nodes' modules are imported.

Of the 3 s of CPU that a node costs before it does anything, nearly all are imports, and the graph tests start about two
hundred nodes. A forked node is a process like any other: own pid, own DDS participant, killed, stopped and awaited in
the same way. That `python -m wm_nodes.nodes.NAME` works too is what the tests of the launch files and of the run show.
"""

import gc
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

PRELOADED = (
    "clip_evaluator", "environment", "evaluation", "learner", "player", "policy", "recorder", "reward_evaluator",
    "video_learner", "video_model",
)  # fmt: skip
REAP_S = 0.01
ANSWER_S = 60.0


class ForkedNode:
    """What the tests need of subprocess.Popen."""

    def __init__(self, forks: "Forks", pid: int, args: list[str]) -> None:
        self.pid, self.args = pid, args
        self.returncode: int | None = None
        self._forks = forks

    def poll(self) -> int | None:
        if self.returncode is None:
            self.returncode = self._forks.exit_code(self.pid)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if deadline is not None and time.monotonic() >= deadline:
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
            time.sleep(REAP_S)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Forks:
    """The client of one fork server; the server and its nodes end with this process."""

    def __init__(self) -> None:
        self._connection, theirs = Pipe()
        command = [sys.executable, __file__, str(theirs.fileno())]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        self._server = subprocess.Popen(command, env=environment, pass_fds=[theirs.fileno()])
        theirs.close()
        self._lock = threading.Lock()
        self._exit_codes: dict[int, int] = {}

    def start(self, module: str, args: list[str], environment: dict[str, str], log: Path) -> ForkedNode:
        """Run module.main() with sys.argv[1:] = args, its output appended to `log`."""
        log.touch()
        request = {"module": module, "args": args, "environment": environment, "log": str(log)}
        with self._lock:
            self._connection.send_bytes(json.dumps(request).encode())
            while (answer := self._receive(ANSWER_S))["event"] != "started":
                self._exit_codes[answer["pid"]] = answer["code"]
        return ForkedNode(self, answer["pid"], [module, *args])

    def exit_code(self, pid: int) -> int | None:
        """Of an ended node, as Popen.returncode gives it."""
        with self._lock:
            while self._connection.poll():
                answer = self._receive(0.0)
                self._exit_codes[answer["pid"]] = answer["code"]
        return self._exit_codes.get(pid)

    def close(self) -> None:
        self._connection.close()
        self._server.wait(10)

    def _receive(self, timeout_s: float) -> dict[str, int]:
        if not self._connection.poll(timeout_s):
            raise TimeoutError(f"the fork server did not answer within {timeout_s:g} s")
        answer: dict[str, int] = json.loads(self._connection.recv_bytes())
        return answer


def serve(connection: Connection) -> dict[str, str]:
    """Fork a child for each request until the client hangs up. Returns in the child only, with its request."""
    for name in PRELOADED:
        importlib.import_module(f"wm_nodes.nodes.{name}_node")
    importlib.import_module("wm_nodes.simulation.environment")
    gc.collect()
    gc.freeze()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    children: set[int] = set()
    while True:
        try:
            request = json.loads(connection.recv_bytes()) if connection.poll(REAP_S) else None
        except EOFError:
            for pid in children:
                os.kill(pid, signal.SIGKILL)
            os._exit(0)
        if request is not None:
            pid = os.fork()
            if not pid:
                connection.close()
                return request
            children.add(pid)
            connection.send_bytes(json.dumps({"event": "started", "pid": pid}).encode())
        for pid in list(children):
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                children.remove(pid)
                code = os.waitstatus_to_exitcode(status)
                connection.send_bytes(json.dumps({"event": "ended", "pid": pid, "code": code}).encode())


def main() -> None:
    request = serve(Connection(int(sys.argv[1])))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    log = os.open(request["log"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[:0] = os.environ["PYTHONPATH"].split(os.pathsep)
    sys.argv = [request["module"], *request["args"]]
    code = importlib.import_module(request["module"]).main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # an interpreter's end takes 0.4 s of CPU in torch's destructors


if __name__ == "__main__":
    main()
