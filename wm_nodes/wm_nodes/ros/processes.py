"""One node's process: own session and process group, prefixed output, ended with its parent."""

import ctypes
import os
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TextIO

from wm_nodes.ros.graph import NodeSpec

COLOURS = (36, 33, 32, 35, 34, 96, 93, 92, 95, 94)
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)


class NodeProcess:
    """The process of one NodeSpec, startable again. colour: index into COLOURS, or None for plain text."""

    def __init__(
        self, spec: NodeSpec, python: str, env: Mapping[str, str], *, log: TextIO | None, colour: int | None,
        width: int = 0, file: Path | None = None,
    ) -> None:  # fmt: skip
        self.spec = spec
        self.command = [python, *spec.program(), *spec.ros_arguments()]
        self.ended_at: float | None = None
        """time.monotonic() of the end, or None while it runs."""
        self._env = {**env, **spec.environment}
        self._log = log
        label = spec.label.ljust(width)
        self._prefix = f"[{label}] " if colour is None else f"\x1b[{COLOURS[colour % len(COLOURS)]}m[{label}]\x1b[0m "
        self._file = file
        self._lines: deque[str] = deque(maxlen=1000)
        self._process: subprocess.Popen[str] | None = None
        self._ended = threading.Event()
        self._pump: threading.Thread | None = None

    @property
    def running(self) -> bool:
        return self._process is not None and not self._ended.is_set()

    @property
    def pid(self) -> int:
        return self._started().pid

    @property
    def exit_code(self) -> int:
        """As a shell gives it: 128 + signal; 1 for one that ended with 0 although nobody told it to."""
        code = self.wait(0.0)
        return 128 - code if code < 0 else code or 1

    def start(self) -> None:
        """Start the process; the calling thread must live as long as the process is to live."""
        self.ended_at = None
        self._ended.clear()
        self._process = subprocess.Popen(
            self.command, env=self._env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, errors="replace", start_new_session=True, preexec_fn=_end_with_parent,
        )  # fmt: skip
        self._pump = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._pump.start()
        threading.Thread(target=self._reap, args=(self._process,), daemon=True).start()

    def signal(self, number: int) -> None:
        """Signal the whole group; nothing happens where it has ended."""
        if self.running:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, number)

    def wait(self, timeout_s: float) -> int:
        """Return the exit code (negative: the signal). Raises TimeoutError where it still runs."""
        process = self._started()
        if not self._ended.wait(timeout_s):
            raise TimeoutError(f"{self.spec.label} still runs after {timeout_s:g} s")
        return int(process.returncode)

    def close(self) -> None:
        """After the end: let the output be read to its end."""
        if self._pump is not None:
            self._pump.join(timeout=5.0)

    def output(self) -> str:
        """The last 1000 lines."""
        return "".join(list(self._lines))

    def obituary(self) -> str:
        """One line for people: who ended, how, its last words, where the rest is."""
        self.close()
        code = self.wait(0.0)
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        return f"required node {self.spec.label} {how}: {self.last_words()}"

    def last_words(self) -> str:
        """The last line written, and where the rest is."""
        last = next((line.strip() for line in reversed(self._lines) if line.strip()), "no output")
        return last + (f" (log: {self._file})" if self._file else "")

    def _read(self, process: "subprocess.Popen[str]") -> None:
        if process.stdout is None:
            return
        with ExitStack() as stack:
            sink = stack.enter_context(self._file.open("a")) if self._file is not None else None
            for line in process.stdout:
                self._lines.append(line)
                if sink is not None:
                    sink.write(line)
                    sink.flush()
                if self._log is not None:
                    self._log.write(f"{self._prefix}{line.rstrip()}\n")
                    self._log.flush()

    def _reap(self, process: "subprocess.Popen[str]") -> None:
        """Wait for the end; then end what is left of the group, before its number can belong to anybody else."""
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        self.ended_at = time.monotonic()
        self._ended.set()

    def _started(self) -> "subprocess.Popen[str]":
        if self._process is None:
            raise RuntimeError(f"{self.spec.label} was never started")
        return self._process


def _end_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
