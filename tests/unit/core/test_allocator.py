"""The C library's allocator keeps what an array leaves."""

import os
import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
import torch
from wm_nodes.core.memory import keep_freed_memory

torch.set_num_threads(1)
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def once():
    [torch.ones(1_000_000) for _ in range(8)]
for _ in range(3):
    once()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    once()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(how: str) -> int:
    """Of a step that makes eight arrays of 4 MB and leaves them, twenty times after the first three."""
    always = os.environ | {"MALLOC_MMAP_THRESHOLD_": "131072"}  # else what is given back depends on the addresses
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, how], env=always, capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps its own rules")
def test_equal_steps_touch_no_new_pages() -> None:
    assert page_faults("keep") < 100
    assert page_faults("leave") > 1000
