"""One goal at work in a thread, and what such work needs of its node."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from wm_nodes.ros.diagnostics import Diagnostics
from wm_nodes.ros.wire import Cancelled


class WorkerNode(Protocol):
    """A node whose work runs in a thread; ros.lifecycle.ManagedNode is one."""

    diagnostics: Diagnostics
    actions: list[Any]
    """The WorkerActions that it serves."""

    @property
    def active(self) -> bool: ...

    def param(self, name: str) -> Any: ...

    def say_failed_goal(self, text: str) -> None: ...

    def own(self, destroy: Callable[..., object], *arguments: Any) -> None: ...

    def get_logger(self) -> Any: ...

    def get_namespace(self) -> str: ...


@dataclass
class Work:
    """One goal at work. request: the goal message; feedback(message) publishes feedback."""

    request: Any
    feedback: Callable[[Any], None]
    _stop: threading.Event
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
