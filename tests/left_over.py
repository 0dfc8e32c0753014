"""Shared memory of Fast DDS that killed processes left: whoever needs a lock that one of them held waits for ever."""

from contextlib import suppress
from pathlib import Path

from graph.shm_maps import mapped, processes

from wm_nodes.launching.environment import graph_environment
from wm_nodes.launching.runner import clean_shared_memory


def remove_left_over(*, ports: bool = True) -> None:
    """Remove the files of dead processes in /dev/shm; those of living ones are locked or mapped and stay.

    ports: also those whose lock file is gone, which Fast DDS's own tool passes over.
    """
    clean_shared_memory(graph_environment())
    if not ports:
        return
    in_use = set[str]().union(*map(mapped, processes()))
    for port in Path("/dev/shm").glob("fastrtps_port*"):
        if str(port) not in in_use:
            for path in (port, port.with_name(f"sem.{port.name}_mutex")):
                with suppress(OSError):
                    path.unlink()
