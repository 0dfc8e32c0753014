"""The limit of a process's data, set in real processes, and what it is by default."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from wm_nodes.core.memory import GIB, memory_bytes

MACHINE = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
TRY = """
import mmap, sys
from wm_nodes.core.memory import limit_memory
print(limit_memory(float(sys.argv[1]), int(sys.argv[2])))
shared = mmap.mmap(-1, 3 * 2**30)
try:
    bytearray(3 * 2**29)
    print("room")
except MemoryError:
    print("no room")
"""


@pytest.mark.parametrize(
    ("given", "processes", "said"), [(1.0, 1, "1.0 no room"), (1.0, 2, "2.0 room"), (0.0, 1, "0.0 room")]
)
def test_a_process_gets_no_more_data_than_its_limit_and_shared_memory_does_not_count(
    given: float, processes: int, said: str
) -> None:
    command = [sys.executable, "-c", TRY, str(given), str(processes)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert " ".join(done.stdout.splitlines()) == said


def test_without_a_number_a_process_gets_an_eighth_of_the_memory_and_at_least_3_gib() -> None:
    command = [sys.executable, "-c", TRY, "-1", "1"]
    limit, room = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert float(limit) == pytest.approx(max(3.0, memory_bytes() / GIB / 8)) and room == "room"


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/", {"sys/fs/cgroup/memory.max": "1073741824"}, GIB),
        ("0::/a/b", {"sys/fs/cgroup/a/b/memory.max": "max", "sys/fs/cgroup/a/memory.max": "2147483648"}, 2 * GIB),
        ("5:cpu,memory:/x\n0::/", {"sys/fs/cgroup/memory/x/memory.limit_in_bytes": "1073741824"}, GIB),
        ("5:memory:/x", {"sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712"}, MACHINE),
        ("", {}, MACHINE),
    ],
)
def test_a_container_has_the_memory_of_its_group_and_of_those_above_it(
    groups: str, files: dict[str, str], expected: int, tmp_path: Path
) -> None:
    for name, text in {"proc/self/cgroup": groups, **files}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    assert memory_bytes(tmp_path) == expected
