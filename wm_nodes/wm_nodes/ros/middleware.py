"""Settings of the middleware that every node has, launched or not. Standard library only."""

import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

PROFILE = Path(__file__).with_name("fastdds_profile.xml")
"""Fast DDS: shared-memory segment of 32 MiB, messages up to 8 MiB (larger images would be lost, or wait 12 ms)."""

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
SEGMENT_BYTES = 40 * 2**20
"""Shared memory that one process may take with the profile."""

_USUAL_NODES = 8
_PORT = re.compile(r"/dev/shm/fastrtps_port(\d+)\b")
_FIRST_PORT, _PORTS_PER_DOMAIN = 7400, 250
"""Of DDS."""
_GRAPH_PORTS = range(7000, 7400)
"""Of rmw_fastrtps: what each node of any domain tells of its topics, from which the others see whom they matched."""


def set_node_defaults() -> None:
    """Give a node that no launcher started the launchers' defaults: this host only, and the Fast DDS profile.

    Called before rclpy.init. What is set stays; an empty profile variable (the runner's word for "/dev/shm is too
    small") is removed.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if os.environ.get(PROFILE_VARIABLE) == "":
        del os.environ[PROFILE_VARIABLE]
    elif Path("/dev/shm").is_dir() and shutil.disk_usage("/dev/shm").free >= _USUAL_NODES * SEGMENT_BYTES:
        os.environ.setdefault(PROFILE_VARIABLE, str(PROFILE))


@contextmanager
def dead_ports_held() -> Iterator[None]:
    """Let a DDS participant that is made meanwhile take no port of a dead process that living ones still write to.

    Fast DDS 2.14 gives a new process the port of a killed one and removes its shared memory by name, unseen by those
    that have it mapped: they may write there for ever, or remove the new memory, and the new process hears nobody
    (https://github.com/eProsima/Fast-DDS/issues/5053). A port whose lock is held is passed over.
    """
    first = _FIRST_PORT + _PORTS_PER_DOMAIN * int(os.environ.get("ROS_DOMAIN_ID") or 0)
    with ExitStack() as held:
        for port in mapped_ports() & {*_GRAPH_PORTS, *range(first, first + _PORTS_PER_DOMAIN)}:
            lock = Path(f"/dev/shm/fastrtps_port{port}_el")
            with suppress(OSError):
                new = not lock.exists()
                file = held.enter_context(lock.open("ab"))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if new:
                    held.callback(lock.unlink, missing_ok=True)
        yield


def mapped_ports() -> set[int]:
    """Fast DDS ports whose shared memory some process has mapped, even under a name that is gone."""
    ports = set[int]()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with suppress(OSError):
            ports.update(map(int, _PORT.findall(maps.read_text(encoding="utf-8", errors="replace"))))
    return ports
