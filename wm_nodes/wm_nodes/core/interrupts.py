"""Ctrl-C before a command has begun anything: one line and exit code 130."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def leaving_when_interrupted() -> Iterator[None]:
    """Around imports, in the main thread: a KeyboardInterrupt in them ends in a trace, or becomes another error."""
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:  # whoever started this command ignores Ctrl-C, or has his own way
        yield
        return
    signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _leave(*_signal: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(128 + signal.SIGINT)
