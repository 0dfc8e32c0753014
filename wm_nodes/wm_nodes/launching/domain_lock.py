"""One graph per ROS domain and host: a lock file for each domain, held as long as the process lives."""

import fcntl
import os
from collections.abc import Iterable
from pathlib import Path

from wm_nodes.core.errors import RunError

LOCK_FOLDER = Path("/tmp/wm_nodes_domains")


class DomainInUseError(RunError):
    """Another graph of ours runs on this domain; the text says which, and what to do."""


class DomainLock:
    """Context manager that holds a domain.

    Args:
        domain: 0 to 101, so that DDS's ports lie below those that Linux hands out.
        holder: what the error of a second graph says, e.g. the scenario and run folder.
        group: locks of different groups do not see each other.
    """

    def __init__(self, domain: int, holder: str, *, group: str = "graph", folder: Path = LOCK_FOLDER) -> None:
        if not 0 <= domain <= 101:
            raise ValueError(f"ROS domain must be 0 to 101, got {domain}; set ROS_DOMAIN_ID or domain_id:=")
        self.domain = domain
        self._holder = holder
        self._path = folder / f"{group}-{domain}.lock"
        self._file: int | None = None

    def acquire(self) -> None:
        """Take the lock.

        Raises:
            DomainInUseError: it is held; names the holder.
        """
        if not self._path.parent.is_dir():
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.parent.chmod(0o1777)
        file, writable = _open(self._path)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(file, 4096, 0).decode(errors="replace") or "another graph"
            os.close(file)
            raise DomainInUseError(
                f"ROS domain {self.domain} is already in use on this host by {holder}; stop it, or start this one on "
                f"another domain: domain_id:={(self.domain + 1) % 102}, or ROS_DOMAIN_ID={(self.domain + 1) % 102}"
            ) from None
        if writable:
            os.ftruncate(file, 0)
            os.pwrite(file, f"{self._holder} (process {os.getpid()})".encode(), 0)
        self._file = file

    def release(self) -> None:
        """Let go; the file stays, because removing it would race with the next holder."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def __enter__(self) -> "DomainLock":
        self.acquire()
        return self

    def __exit__(self, *error: object) -> None:
        self.release()


def first_free(domains: Iterable[int], holder: str, *, group: str) -> DomainLock:
    """Return the held lock of the first free domain.

    Raises:
        DomainInUseError: all are held.
    """
    tried = list(domains)
    for domain in tried:
        lock = DomainLock(domain, holder, group=group)
        try:
            lock.acquire()
        except DomainInUseError:
            continue
        return lock
    raise DomainInUseError(
        f"all ROS domains {tried[:1]}..{tried[-1:]} are in use on this host; stop a graph or a test run"
    )


def _open(path: Path) -> tuple[int, bool]:
    """Open for writing, or read-only where the file belongs to another user: flock needs no more."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), True
    except PermissionError:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC), False
