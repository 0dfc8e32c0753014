"""One goal at work in a thread."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from wm_nodes.ros.wire import Cancelled


@dataclass
class Work:
    """One goal at work."""

    request: Any
    """The goal message."""
    feedback: Callable[[Any], None]
    """Publishes a feedback message."""
    _stop: threading.Event
    """Set when it must stop."""
    reason: str = ""
    """Why it must stop: "cancelled", "deactivated", ...; empty while it may go on."""

    @property
    def stopped(self) -> bool:
        return self._stop.is_set()

    def stop(self, reason: str) -> None:
        self.reason = self.reason or reason
        self._stop.set()

    def check(self) -> None:
        """Raise Cancelled when the work must stop; call at least twice a second."""
        if self.stopped:
            raise Cancelled(self.reason)

    def sleep(self, seconds: float) -> None:
        """Wait, but raise Cancelled as soon as the work must stop."""
        self._stop.wait(seconds)
        self.check()
