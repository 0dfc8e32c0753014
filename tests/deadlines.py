"""Times that the product promises, on a machine that does other things, too."""

import os
from pathlib import Path


def within(seconds: float) -> float:
    """A time that the product promises, in seconds of this machine: where more processes want to run than there are
    cores, each gets its share of one, and everything takes longer in proportion."""
    average, *_, running, _ = Path("/proc/loadavg").read_text(encoding="utf-8").split()
    wanting = max(float(average), int(running.partition("/")[0]))
    return seconds * max(1.0, wanting / (os.cpu_count() or 1))
