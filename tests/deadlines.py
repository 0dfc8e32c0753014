"""How long tests wait, and times that the product promises, on a machine that does other things, too."""

import os
from pathlib import Path

PATIENCE_S = 120.0
"""What comes is waited for so long at most, however busy the machine is: this ends a test that hangs, and is no promise
of ours."""


def within(seconds: float) -> float:
    """A time that the product promises, in seconds of this machine: where more processes want to run than there are
    cores, each gets its share of one, and everything takes longer in proportion."""
    average, *_, running, _ = Path("/proc/loadavg").read_text(encoding="utf-8").split()
    wanting = max(float(average), int(running.partition("/")[0]))
    return seconds * max(1.0, wanting / (os.cpu_count() or 1))
