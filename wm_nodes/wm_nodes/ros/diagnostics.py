"""/diagnostics of one node: counters, latencies, gauges and standing conditions; 1 Hz and at once on a level change."""

import shutil
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

OK, WARN, ERROR = 0, 1, 2
_LEVELS = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)

EVENT_HOLD_S = 5.0
"""How long a counted problem keeps the level raised."""

DISK_ERROR_BYTES = 1 << 30
LATENCY_SAMPLES = 1024


class Diagnostics:
    """Thread-safe: workers count, the executor's timer publishes.

    Args:
        name: node name, the part before ':' of the status name.
        hardware_id: the run id.
        publish: publishes a DiagnosticArray, or does nothing while the node has no publisher.
        now: returns a builtin_interfaces/Time.
        run_dir: disk space is watched there; None: not watched.
    """

    def __init__(self, name: str, hardware_id: str, publish: Any, now: Any, run_dir: Path | None = None) -> None:
        self._name, self._hardware_id, self._run_dir = name, hardware_id, run_dir
        self._publish, self._now = publish, now
        self._lock = threading.Lock()
        self._counters: dict[str, int] = {}
        self._gauges: dict[str, str] = {}
        self._latencies: dict[str, deque[float]] = {}
        self._events: dict[str, tuple[int, str, float]] = {}
        self._conditions: dict[str, tuple[int, str]] = {}
        self._level = OK

    def count(self, key: str, number: int = 1, *, level: int = WARN, text: str = "") -> None:
        """Add to a counter of something that went wrong; raises the level for EVENT_HOLD_S."""
        with self._lock:
            self._counters[key] = self._counters.get(key, 0) + number
            if level > OK:
                self._events[key] = (level, text or key.replace("_", " "), time.monotonic())
        self.refresh()

    def gauge(self, key: str, value: object) -> None:
        """Set a value that is shown as it is."""
        with self._lock:
            self._gauges[key] = f"{value:.4g}" if isinstance(value, float) else str(value)

    def latency(self, key: str, seconds: float) -> None:
        """Note one duration; shown as <key>_p50_ms and <key>_p99_ms over the newest LATENCY_SAMPLES."""
        with self._lock:
            self._latencies.setdefault(key, deque(maxlen=LATENCY_SAMPLES)).append(seconds)

    def set_condition(self, key: str, level: int, text: str) -> None:
        """Raise the level until clear_condition(key)."""
        with self._lock:
            self._conditions[key] = (level, text)
        self.refresh()

    def clear_condition(self, key: str) -> None:
        with self._lock:
            present = self._conditions.pop(key, None) is not None
        if present:
            self.refresh()

    def show_estop(self, stopped: bool) -> None:
        """The emergency stop as a standing condition, until it is released."""
        if stopped:
            text = "the emergency stop is set: nothing acts; when it is safe, publish false on safety/estop to go on"
            self.set_condition("estop", ERROR, text)
        else:
            self.clear_condition("estop")

    def refresh(self) -> None:
        """Publish now if the level has changed since the last message."""
        if self._summary()[0] != self._level:
            self.publish()

    def publish(self) -> None:
        """Publish the full status."""
        level, text = self._summary()
        self._level = level
        status = DiagnosticStatus(
            level=_LEVELS[level], name=f"{self._name}: status", message=text, hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in self._values().items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._now()
        self._publish(message)

    def _summary(self) -> tuple[int, str]:
        now = time.monotonic()
        with self._lock:
            self._events = {k: event for k, event in self._events.items() if now - event[2] < EVENT_HOLD_S}
            raised = [(level, text) for level, text, _ in self._events.values()] + list(self._conditions.values())
        if (free := self._disk_free()) is not None and free < DISK_ERROR_BYTES:
            raised.append((ERROR, f"only {free / 2**20:.0f} MiB free in {self._run_dir}; free some space"))
        if not raised:
            return OK, "ok"
        worst = max(level for level, _ in raised)
        return worst, "; ".join(text for level, text in raised if level == worst)

    def _values(self) -> dict[str, str]:
        with self._lock:
            values = dict(self._gauges)
            values.update({key: str(number) for key, number in self._counters.items()})
            for key, samples in self._latencies.items():
                p50, p99 = np.percentile(np.asarray(samples), (50, 99)) * 1e3
                values[f"{key}_p50_ms"], values[f"{key}_p99_ms"] = f"{p50:.3f}", f"{p99:.3f}"
        if (free := self._disk_free()) is not None:
            values["disk_free_mib"] = f"{free / 2**20:.0f}"
        if Path("/dev/shm").is_dir():
            values["shm_free_mib"] = f"{shutil.disk_usage('/dev/shm').free / 2**20:.0f}"
        return values

    def _disk_free(self) -> int | None:
        return shutil.disk_usage(self._run_dir).free if self._run_dir is not None and self._run_dir.is_dir() else None
