"""What work on a device costs the host, by kind and by line of our source; tests/pretended_device.py fills it in."""

import sys
from collections import Counter
from pathlib import Path

KERNELS, WAITS, UP, DOWN = "kernels", "waits", "copies up", "copies down"
ROOT = Path(__file__).resolve().parents[1]
PRETENCE = {__file__, str(Path(__file__).with_name("pretended_device.py"))}


class Counts:
    """What the work since the last reset would cost on a device.

    Attributes:
        kernels: started by the host; views and empty tensors start none, a foreach operation one.
        waits: the host waits for a value or a size: item(), bool(), tolist(), nonzero(), an index by a mask, and every
            copy down. Copies up are not among them, though one from ordinary memory holds the host up, too.
        copies_up, copies_down, bytes_up, bytes_down: to the device and back.
    """

    def __init__(self) -> None:
        self._times: Counter[tuple[str, str, str]] = Counter()
        self._bytes: Counter[str] = Counter()

    def reset(self) -> None:
        """Begin at zero again; tensors stay where they are."""
        self._times.clear()
        self._bytes.clear()

    kernels = property(lambda self: self.by_kind(KERNELS).total())
    waits = property(lambda self: self.by_kind(WAITS).total())
    copies_up = property(lambda self: self.by_kind(UP).total())
    copies_down = property(lambda self: self.by_kind(DOWN).total())
    copies = property(lambda self: self.copies_up + self.copies_down)
    bytes_up = property(lambda self: self._bytes[UP])
    bytes_down = property(lambda self: self._bytes[DOWN])

    def by_kind(self, what: str) -> Counter[str]:
        """Return how often there was `what` (KERNELS, WAITS, UP or DOWN), by operation."""
        return self._sum(what, 1)

    def by_line(self, what: str) -> Counter[str]:
        """Return the same by file:line of the innermost code of ours; a backward pass is the line that began it."""
        return self._sum(what, 2)

    def report(self, most: int = 12) -> str:
        """Return the totals, each followed by the `most` costly source lines."""
        lines = []
        for what in (KERNELS, WAITS, UP, DOWN):
            size = f", {self._bytes[what]:,} bytes" if self._bytes[what] else ""
            lines.append(f"{what}: {self.by_kind(what).total()}{size}")
            lines += [f"  {times:6} {line}" for line, times in self.by_line(what).most_common(most)]
        return "\n".join(lines)

    def add(self, what: str, kind: str, size: int = 0) -> None:
        """Count one `what`, of `size` bytes."""
        self._times[what, kind, _our_line()] += 1
        self._bytes[what] += size

    def _sum(self, what: str, column: int) -> Counter[str]:
        found: Counter[str] = Counter()
        for key, times in self._times.items():
            if key[0] == what:
                found[key[column]] += times
        return found


def _our_line() -> str:
    frame = sys._getframe(2)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(f"{ROOT}/") and name not in PRETENCE and "/.venv" not in name:
            return f"{name[len(str(ROOT)) + 1:]}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"
