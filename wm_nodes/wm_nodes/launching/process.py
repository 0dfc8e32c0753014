"""One node's process: own process group, prefixed output, ended with its parent."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TextIO

from wm_nodes.launching.fork_server import ForkServer, ForkServerError, end_group, end_with_parent
from wm_nodes.launching.graph import NodeSpec

COLOURS = (36, 33, 32, 35, 34, 96, 93, 92, 95, 94)


class NodeProcess:
    """The process of one NodeSpec, startable again. colour: index into COLOURS, or None for plain text."""

    def __init__(
        self, spec: NodeSpec, python: str, env: Mapping[str, str], *, log: TextIO | None, colour: int | None,
        width: int = 0, file: Path | None = None,
    ) -> None:
        self.spec = spec
        self.command = [python, *spec.program(), *spec.ros_arguments()]
        self.started_at = 0.0
        self.ended_at: float | None = None
        """time.monotonic() of the end, or None while it runs."""
        self._env = env
        self._log = log
        label = spec.label.ljust(width)
        self._prefix = f"[{label}] " if colour is None else f"\x1b[{COLOURS[colour % len(COLOURS)]}m[{label}]\x1b[0m "
        self._file = file
        self._last_line = "no output"
        self.pid = 0
        """0 before the first start."""
        self._code = 0
        self._ended = threading.Event()
        self._pump: threading.Thread | None = None

    @property
    def running(self) -> bool:
        return self.pid != 0 and not self._ended.is_set()

    @property
    def exit_code(self) -> int:
        """As a shell gives it: 128 + signal; 1 for one that ended with 0 although nobody told it to."""
        code = self.wait(0.0)
        return 128 - code if code < 0 else code or 1

    def start(self, forks: ForkServer | None = None) -> None:
        """Start the process, in an interpreter of its own where no fork server answers; the calling thread must live as
        long as the process is to live.
        """
        self.started_at, self.ended_at = time.monotonic(), None
        self._ended.clear()
        reader, output = os.pipe()
        try:
            self.pid, wait = self._launch(forks, output)
        except BaseException:
            os.close(reader)
            raise
        finally:
            os.close(output)
        lines = os.fdopen(reader, encoding="utf-8", errors="replace")
        self._pump = threading.Thread(target=self._read, args=(lines,), daemon=True)
        self._pump.start()
        threading.Thread(target=self._reap, args=(wait,), daemon=True).start()

    def signal(self, number: int) -> None:
        """Signal the whole group; nothing happens where it has ended."""
        if self.running:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, number)

    def wait(self, timeout_s: float) -> int:
        """Return the exit code (negative: the signal). Raises TimeoutError where it still runs."""
        if self.pid and not self._ended.wait(timeout_s):
            raise TimeoutError(f"{self.spec.label} still runs after {timeout_s:g} s")
        return self._code

    def close(self) -> None:
        """After the end: let the output be read to its end."""
        if self._pump is not None:
            self._pump.join(timeout=5.0)

    def exit_summary(self) -> str:
        """One line for people: who ended, how, its last output, where the rest is."""
        self.close()
        code = self.wait(0.0)
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        kind = "required node" if self.spec.required else "node"
        return f"{kind} {self.spec.label} {how}: {self.last_output_line()}"

    def last_output_line(self) -> str:
        """The last line written, and where the rest is."""
        return self._last_line + (f" (log: {self._file})" if self._file else "")

    def _launch(self, forks: ForkServer | None, output: int) -> tuple[int, Callable[[], int]]:
        """Return the pid, and what waits for the exit code."""
        if forks is not None:
            with suppress(ForkServerError):
                pid, end = forks.start(self.command[2:], self._env, output)
                return pid, end.result
        process = subprocess.Popen(
            self.command, env=self._env, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
            start_new_session=True, preexec_fn=end_with_parent,
        )
        return process.pid, partial(_await, process)

    def _read(self, stream: TextIO) -> None:
        with ExitStack() as stack:
            stack.enter_context(stream)
            sink = stack.enter_context(self._file.open("a", encoding="utf-8")) if self._file is not None else None
            for line in stream:
                self._last_line = line.strip() or self._last_line
                if sink is not None:
                    sink.write(line)
                    sink.flush()
                if self._log is not None:
                    with suppress(OSError):  # its reader has gone, e.g. `| head`; the file and the node go on
                        self._log.write(f"{self._prefix}{line.rstrip()}\n")
                        self._log.flush()

    def _reap(self, wait: Callable[[], int]) -> None:
        self._code = wait()
        self.ended_at = time.monotonic()
        self._ended.set()


def _await(process: "subprocess.Popen[bytes]") -> int:
    """Wait for the end, also of what is left of the group."""
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    end_group(process.pid)
    return process.wait()
