"""Ctrl-C before a command has begun anything: one line and exit code 130."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def leaving_when_interrupted() -> Iterator[None]:
    """Around imports, in the main thread: a KeyboardInterrupt in them ends in a trace, or becomes another error."""
    with _answering(_leave):
        yield


@contextmanager
def remembering_interrupts() -> Iterator[Callable[[], None]]:
    """Around preparations, in the main thread: gives a function that raises a KeyboardInterrupt again that came and was
    lost, as in a destructor or in a look-up in C. One that became another error, as in an import in C, comes out as a
    KeyboardInterrupt."""
    received = list[int]()

    def note(number: int, _frame: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    def check() -> None:
        if received:
            raise KeyboardInterrupt

    with _answering(note):
        try:
            yield check
        except Exception:
            check()
            raise


@contextmanager
def _answering(handler: Callable[[int, object], None]) -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:  # whoever started this command ignores Ctrl-C, or has his own way
        yield
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _leave(_number: int, _frame: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(128 + signal.SIGINT)
