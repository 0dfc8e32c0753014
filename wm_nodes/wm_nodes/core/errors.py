"""Errors that more than one room raises: their text says what happened and what to do."""

from collections.abc import Sequence


class RunError(RuntimeError):
    """A run cannot go on, for a reason outside of this program, e.g. a node that ended."""


class ModelNotAcceptedError(RunError):
    """A world model does not pass acceptance, so no policy may be trained in it."""


class WireError(Exception):
    """A refused request or message: code is one of wm_msgs/ErrorCode, the text names the value and the remedy."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


def first_few(texts: Sequence[str], most: int = 5) -> str:
    """The first of several texts, and how many more there are."""
    more = f"; and {len(texts) - most} more" if len(texts) > most else ""
    return "; ".join(texts[:most]) + more
