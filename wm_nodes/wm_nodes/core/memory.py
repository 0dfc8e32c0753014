"""How much memory a process may take of its machine or container, and whether it keeps what it freed.

What is limited is the data of a process: its heap and what else it may write and shares with nobody (RLIMIT_DATA).
Address space is no measure of that: of the 2.9 GiB of the simulator's environment 0.7 are data, the rest is libraries,
shared memory and room that is only reserved.
"""

import ctypes
import os
import resource
import sys
from pathlib import Path

GIB = 2**30
SHARES = 8
"""A graph has up to eight processes, so none of them together can take all memory."""
LEAST_GIB = 3.0
"""Of a share; the largest node that was seen (the simulator's environment, 2026-11-27) took 0.7 GiB."""
CGROUPS = (("sys/fs/cgroup", "memory.max"), ("sys/fs/cgroup/memory", "memory.limit_in_bytes"))
"""Where version 2 and version 1 have their groups, and the file of one."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt(3)."""
KEPT_BYTES = 2**30
OLD_GLIBC_LIMIT = 2**25
"""Largest M_MMAP_THRESHOLD that older versions of glibc take."""


def limit_memory(given_gib: float, processes: int = 1, device: str = "auto") -> float:
    """Limit the data of this process; return the limit in GiB, or 0 for none.

    Args:
        given_gib: of one process; 0: none; negative: an eighth of the memory, and none where the device is a GPU, whose
            driver maps as it likes.
        processes: that this process stands for, e.g. the nodes that it composes.
        device: the setting.
    """
    if given_gib < 0 and _is_gpu(device):
        return 0.0
    limit_gib = processes * (given_gib if given_gib >= 0 else max(LEAST_GIB, memory_bytes() / GIB / SHARES))
    if limit_gib:
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        wanted = int(limit_gib * GIB)
        resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard < 0 else min(wanted, hard), hard))
    return limit_gib


def memory_bytes(root: Path = Path("/")) -> int:
    """The memory of this machine, or of the container (cgroup) where that has less. root: of /proc and /sys."""
    sizes = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    groups = {""}
    for line in _read(root / "proc/self/cgroup").split():
        number, controllers, group = line.split(":", 2)
        if number == "0" or "memory" in controllers.split(","):
            groups |= {str(folder).strip("/") for folder in (Path(group), *Path(group).parents)}
    for group in groups:
        for hierarchy, file in CGROUPS:
            text = _read(root / hierarchy / group / file).strip()
            sizes += [int(text)] if text.isdigit() else []  # version 2 says "max" for none
    return min(sizes)


def keep_freed_memory() -> bool:
    """Keep freed memory in the process; return whether the C library can (glibc; others are left as they are).

    glibc gives large freed blocks back to the system, so that every step of a network touches new pages again.
    The price: up to KEPT_BYTES that are free stay with the process. No number changes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None or not mallopt(M_TRIM_THRESHOLD, KEPT_BYTES):
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, KEPT_BYTES) or mallopt(M_MMAP_THRESHOLD, OLD_GLIBC_LIMIT))


def _is_gpu(device: str) -> bool:
    torch = sys.modules.get("torch")
    return device != "cpu" and torch is not None and bool(torch.cuda.is_available())


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
