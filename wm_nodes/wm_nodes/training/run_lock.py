"""One writer per run folder: a lock file there says which process writes, since when, and on which host.

What a holder's own children do counts as its own, so the nodes of a graph whose launcher holds the folder pass, and a
learner started by hand beside it does not. Standard library only: `ros2 launch` locks under the system's Python.
"""

import atexit
import fcntl
import itertools
import json
import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from wm_nodes.core.processes import stat_fields

NAME = "run.lock"
"""The lock file in the run folder; there is none where nobody holds it."""


class RunFolderInUseError(OSError):
    """Another process writes into the run folder; the text says which, and what to do."""


@dataclass(frozen=True)
class Holder:
    """The process that holds a run folder's lock."""

    host: str
    """Host name."""
    process: int
    """Process number."""
    since: str
    """Local time at which it took the lock, to the second."""
    command: str
    """Its command line, cut after 200 characters."""
    started: int
    """Clock ticks from boot to the process's start, by which a later process of the same number is told; 0: unknown."""
    pid_namespace: str
    """Process numbers mean something in their own container only."""

    def __str__(self) -> str:
        return f"process {self.process} on {self.host} since {self.since} ({self.command})"

    @property
    def seen_from_here(self) -> bool:
        return (self.host, self.pid_namespace) == (socket.gethostname(), _pid_namespace())


class RunLock:
    """Context manager that holds a run folder, which it makes; nothing happens where this process or one that it
    descends from holds it already.

    Args:
        say: told, in one line, where the lock of a process that is gone is taken over.
        new: the folder must be a new one: -2, -3 and so on is put behind its name where there is one already.
    """

    def __init__(self, folder: Path, say: Callable[[str], object] | None = None, *, new: bool = False) -> None:
        self.folder, self.path, self._new = folder, folder / NAME, new
        self._say = say or (lambda text: print(text, file=sys.stderr, flush=True))
        self._held: Holder | None = None
        self._made = False

    def acquire(self) -> None:
        """Take the lock, until release() or the end of the process; of two at the same moment one gets it.

        Raises:
            RunFolderInUseError: it is held, or held on another host, which cannot be asked.
        """
        self._made = self._new or not self.folder.exists()
        if self._new:
            self.folder = _make_new(self.folder)
            self.path = self.folder / NAME
        self.folder.mkdir(parents=True, exist_ok=True)
        while True:
            with _opened(self.path) as file:
                text = _read(file)
                holder = _holder(text)
                if not text:
                    self._held = _this_process()
                    atexit.register(self.release)
                    os.pwrite(file, (json.dumps(asdict(self._held), indent=1) + "\n").encode(), 0)
                    os.fsync(file)
                    return
                if holder is not None and holder.seen_from_here and _is_ancestor(holder):
                    return
                self._refuse(holder)
                gone = f"of {holder}, which is gone" if holder else "file, which cannot be read"
                self._say(f"run folder {self.folder}: taking over the lock {gone}")
                self.path.unlink()

    def release(self) -> None:
        """Let go of what acquire() took, and of a folder that it made and nobody wrote into."""
        atexit.unregister(self.release)
        held, self._held = self._held, None
        if held is None or held.process != os.getpid():
            return
        with suppress(OSError):
            with _opened(self.path) as file:
                if (text := _read(file)) == "" or _holder(text) == held:
                    self.path.unlink()
            if self._made:
                self.folder.rmdir()

    def __enter__(self) -> "RunLock":
        self.acquire()
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def _refuse(self, holder: Holder | None) -> None:
        """Raise RunFolderInUseError where the holder lives, or may live."""
        if holder is None:
            return
        if not holder.seen_from_here:
            raise RunFolderInUseError(
                f"run folder {self.folder} is in use by {holder}, which cannot be checked from here; stop it there, or "
                f"delete {self.path} if that host or container is gone"
            )
        if _started(holder.process) == holder.started:
            raise RunFolderInUseError(
                f"run folder {self.folder} is in use by {holder}; stop it, or give another run_dir"
            )


def _make_new(folder: Path) -> Path:
    """Make a folder that no other process has made, and return it."""
    for number in itertools.count(1):
        free = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        with suppress(FileExistsError):
            free.mkdir(parents=True)
            break
    return free


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    """The lock file, made where it is missing, while no other process has it open so."""
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except PermissionError as error:  # another user's: enough to say who holds it
            try:
                file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            except FileNotFoundError:
                raise error from None
        try:
            with suppress(OSError):  # a file system without flock: two at the same moment are not told apart
                fcntl.flock(file, fcntl.LOCK_EX)
            if _is_at(path, file):  # not deleted by the holder before
                yield file
                return
        finally:
            os.close(file)


def _is_at(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


def _read(file: int) -> str:
    return os.pread(file, 65536, 0).decode(errors="replace")


def _holder(text: str) -> Holder | None:
    """None where the text is not what acquire() writes, e.g. after a power cut."""
    try:
        return Holder(**json.loads(text))
    except (ValueError, TypeError):
        return None


def _this_process() -> Holder:
    command = " ".join(" ".join(sys.argv).split())
    return Holder(
        socket.gethostname(), os.getpid(), datetime.now().isoformat(" ", "seconds"), command[:200],
        _started(os.getpid()) or 0, _pid_namespace(),
    )


def _is_ancestor(holder: Holder) -> bool:
    """Whether the holder is this process or one that it descends from."""
    process: int | None = os.getpid()
    while process and process != holder.process:
        fields = stat_fields(process)
        process = int(fields[1]) if fields else None
    return bool(process) and _started(holder.process) == holder.started


def _started(process: int) -> int | None:
    """Clock ticks from boot to the start of a living process; None: there is none."""
    fields = stat_fields(process)
    return int(fields[19]) if fields and fields[0] not in "ZX" else None


def _pid_namespace() -> str:
    with suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return ""  # a kernel without them
