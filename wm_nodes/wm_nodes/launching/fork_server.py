"""Node processes that fork from one interpreter in which their modules are imported already.

Of the 3 s of CPU that a node costs before it does anything, nearly all are imports; a forked node skips them and shares
their memory with the others. It is a process like any other: own pid and process group, own DDS participant, killed,
stopped and awaited in the same way, and it ends as `python -m MODULE ARGS` does.
"""

import atexit
import ctypes
import faulthandler
import gc
import importlib
import itertools
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

from wm_nodes.core.processes import stat_fields

ANSWER_S = 300.0
"""Longest time for the imports: on a crowded machine they took more than 60 s, and in each node by itself they take
longer."""
CLOSE_S, ORPHAN_S = 1.0, 5.0
"""Time for the server's end, and for a node's whose server is gone; then they are killed."""
MESSAGE_BYTES = 2**20
CUDA_RUNS = (
    "error: importing the nodes has started CUDA, which a fork cannot use, so every node starts in an interpreter of "
    "its own; let modules ask for a GPU in configure, not when they are imported\n"
)
_PR_SET_PDEATHSIG = 1
_prctl = ctypes.CDLL(None, use_errno=True).prctl
"""Looked up here: between fork and exec the loader's lock may be another thread's."""


class ForkServerError(RuntimeError):
    """The server does not answer."""


class ForkServer:
    """A server process and its client. The server ends with close() and with this process, and the kernel then sends
    SIGTERM to every node it made.

    Args:
        python: the interpreter.
        modules: imported before the first fork.
        env: the server's environment; a node gets its own, but what is read while a library loads (OMP_NUM_THREADS,
            LD_LIBRARY_PATH) has been read.

    The calling thread must live as long as the server is to live.
    """

    def __init__(self, python: str, modules: Iterable[str], env: Mapping[str, str]) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [python, "-m", "wm_nodes.launching.fork_server", str(theirs.fileno()), *modules]
        with theirs:
            self._server = subprocess.Popen(
                command, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()], start_new_session=True, preexec_fn=end_with_parent,
            )
        self._starts: dict[int, Future[tuple[int, Future[int]]]] = {}
        """By number of the request, which its answer repeats."""
        self._numbers = itertools.count()
        self._ended = False
        self._ends: dict[int, Future[int]] = {}
        self._lock = threading.Lock()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def start(self, arguments: Sequence[str], env: Mapping[str, str], output: int) -> tuple[int, Future[int]]:
        """Run `python -m *arguments` with this environment, stdout and stderr into the file descriptor.

        Return its pid, and its exit code (negative: the signal) once it has ended.

        Raises:
            ForkServerError: no answer.
        """
        number, started = next(self._numbers), Future[tuple[int, Future[int]]]()
        request = json.dumps({"number": number, "arguments": [*arguments], "env": {**env}}).encode()
        with self._lock:
            self._starts[number] = started
            try:
                socket.send_fds(self._socket, [request], [output])
                if self._ended:
                    raise OSError("it has ended")
                return started.result(ANSWER_S)
            except (OSError, TimeoutError) as error:
                raise ForkServerError(f"the process that starts nodes does not answer: {error!r}") from None
            finally:
                del self._starts[number]

    def close(self) -> None:
        """End the server; nodes that still run are sent SIGTERM."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        try:
            self._server.wait(CLOSE_S)
        except subprocess.TimeoutExpired:  # it still imports
            self._server.kill()
            self._server.wait()
        self._reader.join()
        self._socket.close()

    def _read(self) -> None:
        while message := self._receive():
            answer = json.loads(message)
            pid = answer["pid"]
            if "code" in answer:
                self._ends.pop(pid).set_result(answer["code"])
                continue
            self._ends[pid] = Future()
            if (started := self._starts.get(answer["number"])) is not None:
                started.set_result((pid, self._ends[pid]))
            else:
                end_group(pid)  # who asked for it has given up, and started it otherwise
        for pid, end in self._ends.items():
            _await_orphan(pid)
            end.set_result(-signal.SIGTERM)
        self._ended = True
        for started in [*self._starts.values()]:
            if not started.done():
                started.set_exception(OSError("it has ended"))

    def _receive(self) -> bytes:
        try:
            return self._socket.recv(MESSAGE_BYTES)
        except OSError:
            return b""


def _await_orphan(pid: int) -> None:
    """Wait for a node that the kernel has sent SIGTERM, because its server is gone; kill it after ORPHAN_S."""
    with suppress(ProcessLookupError):
        end = os.pidfd_open(pid)
        try:
            if not select.select([end], [], [], ORPHAN_S)[0]:
                os.killpg(pid, signal.SIGKILL)
                select.select([end], [], [])
        finally:
            os.close(end)


def end_with_parent() -> None:
    """Have the kernel end this process when the thread that made it ends."""
    _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def end_group(pid: int) -> None:
    """End what is left of the group of an ended process, before its number can belong to anybody else."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def serve(connection: socket.socket, modules: Sequence[str]) -> dict[str, Any]:
    """Fork for each request until the client hangs up. Returns in a child only, with its request.

    Where the imports have started CUDA it says so in the output of the first request, and ends.
    """
    for name in modules:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()
    wakes, woken = socket.socketpair()
    woken.setblocking(False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.set_wakeup_fd(woken.fileno())
    children: set[int] = set()
    while True:
        ready = select.select([connection, wakes], [], [])[0]
        if wakes in ready:
            wakes.recv(4096)
            for pid in [pid for pid in children if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)]:
                children.remove(pid)
                end_group(pid)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with suppress(OSError):
                    connection.send(json.dumps({"pid": pid, "code": code}).encode())
        if connection in ready:
            message, files, _, _ = socket.recv_fds(connection, MESSAGE_BYTES, 1)
            if not message:
                os._exit(0)  # the kernel sends SIGTERM to what still runs
            if _cuda_runs():
                os.write(files[0], CUDA_RUNS.encode())
                os._exit(1)
            pid = os.fork()
            if pid == 0:
                end_with_parent()
                os.setpgid(0, 0)
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for end in (connection, wakes, woken):
                    end.close()
                for number in (1, 2):
                    os.dup2(files[0], number)
                os.close(files[0])
                request: dict[str, Any] = json.loads(message)
                return request
            with suppress(OSError):
                os.setpgid(pid, pid)  # also here, so that a signal to the group finds it from the first moment
            os.close(files[0])
            children.add(pid)
            connection.send(json.dumps({"pid": pid, "number": json.loads(message)["number"]}).encode())


def _cuda_runs() -> bool:
    """Whether something in this process has started CUDA."""
    torch = sys.modules.get("torch")
    return torch is not None and bool(torch.cuda.is_initialized())


def main() -> None:
    """`python -m wm_nodes.launching.fork_server FILE_DESCRIPTOR [MODULE ...]`."""
    request = serve(socket.socket(fileno=int(sys.argv[1])), sys.argv[2:])
    faulthandler.enable()  # rclpy's events executor does so, too, but not before the node is there
    os.environ.clear()
    os.environ.update(request["env"])
    known = {*sys.path}
    sys.path[:0] = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path and path not in known]
    module, *arguments = request["arguments"]
    sys.argv = [module, *arguments]
    _show([sys.executable, "-m", *request["arguments"]])
    sys.modules.pop(module, None)
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if isinstance(end.code, int):
            _leave(end.code)
        raise
    except KeyboardInterrupt:  # before the node could take the signal itself
        _leave(128 + signal.SIGINT)


def _show(command: Sequence[str]) -> None:
    """Have ps and pkill -f see the node's own command line in the place of the server's, as far as there is room."""
    first, end = (int(field) for field in stat_fields(os.getpid())[45:47])
    text = "\0".join(command).encode()[: max(0, end - first - 1)]
    ctypes.memmove(first, text.ljust(end - first, b"\0"), end - first)


def _leave(code: int) -> None:
    """End without the destructors of torch, which take 0.4 s of CPU."""
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    main()
