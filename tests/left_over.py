"""Shared memory of Fast DDS that killed processes left: whoever needs a lock that one of them held waits for ever."""

import fcntl
import re
from contextlib import suppress
from pathlib import Path

from graph.shm_maps import mapped, processes

from wm_nodes.launching.runner import clean_shared_memory

LOCKS = ("_el", "_sl")


def remove_left_over(*, ports: bool = True) -> None:
    """Remove the files of dead processes in /dev/shm; those of living ones are locked or mapped and stay.

    ports: also those of ports, which a process that is being started may take just now.
    """
    clean_shared_memory()
    if not ports:
        return
    found = [path for path in Path("/dev/shm").glob("fastrtps_port*") if re.fullmatch(r"fastrtps_port\d+", path.name)]
    in_use = set[str]().union(*map(mapped, processes()))
    for port in found:
        files = [port, port.with_name(f"sem.{port.name}_mutex"), *(port.with_name(port.name + end) for end in LOCKS)]
        if str(port) not in in_use and not any(map(_locked, files[2:])):
            for path in files:
                with suppress(OSError):
                    path.unlink()


def _locked(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False
