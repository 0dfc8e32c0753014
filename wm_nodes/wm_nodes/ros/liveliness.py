"""Liveliness of the nodes of a graph: each publishes a heartbeat on run/state twice a second; a silent one is lost."""

import time

HEARTBEAT_S = 0.5
ASLEEP_S = 3 * HEARTBEAT_S
"""Checks come once per heartbeat. Where one comes later than this, its own process stood still and heard nobody: on a
crowded machine, or in the middleware, where `kill -9` of a node can hold all its peers up for 2 to 3 s (after 4 of
264 kills)."""
AWAKE_S = 2 * HEARTBEAT_S
"""After it stood still a process takes what has come meanwhile; a peer of which nothing has come by then is lost."""


class PeerWatch:
    """Keeps the last time each other node was heard. Times are monotonic, in s; pass `now` in tests."""

    def __init__(self, own_name: str, timeout_s: float) -> None:
        self._own_name, self.timeout_s = own_name, timeout_s
        self._heard: dict[str, float] = {}
        self._lost: set[str] = set()
        self._identities: dict[str, str] = {}
        self._checked: float | None = None

    def heard(self, name: str, now: float | None = None, identity: str = "") -> bool:
        """Note a sign of life of a process; return whether the peer is new or had been lost."""
        if name == self._own_name:
            return False
        self._identities[name] = identity
        returned = name in self._lost or name not in self._heard
        self._lost.discard(name)
        self._heard[name] = time.monotonic() if now is None else now
        return returned

    def left(self, name: str) -> None:
        """A peer said that it stops: its silence is no loss."""
        self._heard.pop(name, None)
        self._identities.pop(name, None)
        self._lost.discard(name)

    def check(self, now: float | None = None) -> list[str]:
        """Return the peers that became lost since the last check. Of the time in which this process stood still, no
        more counts than leaves a peer AWAKE_S to be heard."""
        now = time.monotonic() if now is None else now
        apart = 0.0 if self._checked is None else now - self._checked
        if apart > ASLEEP_S:
            slept_s, enough = apart - HEARTBEAT_S, now - max(0.0, self.timeout_s - AWAKE_S)
            self._heard = {name: max(last, min(last + slept_s, enough)) for name, last in self._heard.items()}
        self._checked = now
        silent = {name for name, last in self._heard.items() if now - last > self.timeout_s}
        fresh = sorted(silent - self._lost)
        self._lost |= silent
        return fresh

    def is_lost(self, name: str) -> bool:
        return name in self._lost

    def silence_s(self, name: str, now: float | None = None) -> float:
        """How long a peer has not been heard; 0 while it was not heard at all."""
        now = time.monotonic() if now is None else now
        return now - self._heard.get(name, now)

    def identity(self, name: str) -> str:
        """The process that a peer is; empty while none is known. Another one than before: it was restarted."""
        return self._identities.get(name, "")

    @property
    def lost(self) -> list[str]:
        return sorted(self._lost)

    @property
    def present(self) -> list[str]:
        return sorted(set(self._heard) - self._lost)
