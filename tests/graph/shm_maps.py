"""Which shared memory a process has mapped; also imported by processes that tests start, so without this project."""

import os
from pathlib import Path


def processes() -> list[str]:
    return [name for name in os.listdir("/proc") if name.isdigit()]


def mapped(process: str) -> set[str]:
    """Paths below /dev/shm that a process (its number, or "self") has mapped, removed ones, too; none once it ended."""
    try:
        lines = Path("/proc", process, "maps").read_text(encoding="utf-8").splitlines()
    except OSError:
        return set()
    return {line.split()[5] for line in lines if "/dev/shm/" in line}
