"""What a short time with a GPU should bring home: a list of points, each measured or left out with a reason."""

import gc
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from benchmarks.speed.stages import memory_mib, restart_peak
from wm_nodes.core.device import CPU, DeviceError, synchronize
from wm_nodes.core.errors import RunError

NOT_HERE = (RunError, DeviceError, OSError, ImportError)
"""Errors of a machine that lacks something, e.g. a renderer; any other is a fault, which the exit code tells."""
MOST_REPEATS, FEWEST_REPEATS = 30, 3
RUNNING, INTERRUPTED, FINISHED = "running", "interrupted", "finished"
WORDS = {"px": "{} px", "envs": "{} environments", "batch": "batch {}"}
"""How a column of that name is put in words."""
LAST_LINES = 2000
"""Characters of a failed point's traceback that are kept."""


@dataclass(frozen=True)
class ModelSize:
    """A size of world model and policy."""

    name: str
    """In the results."""
    preset: str
    """Of policies, whose tokenizer and world model it is."""
    sizes_px: tuple[int, ...]
    """Of each camera's picture."""
    shipped_px: int = 0
    """At which such a model is shipped; 0: none is, and weights are random."""


@dataclass(frozen=True)
class Plan:
    """What is measured."""

    models: tuple[ModelSize, ...]
    """In which imagined steps are counted."""
    envs: tuple[int, ...]
    """Environments of rollouts on the device."""
    loop_envs: tuple[int, ...]
    """Environments of the lock-step loop."""
    trained: tuple[ModelSize, ...]
    """Whose training is timed, at their presets' picture size."""
    batch_shares: tuple[float, ...]
    """Of their presets' batches."""
    agreement_envs: int = 64
    """Environments of the rollout that is compared with the CPU's."""
    num_steps: int = 16
    """Of every rollout."""
    iterations: int = 10
    """Of each training of loop 1."""
    captured: bool = True
    """Also with CUDA graphs."""
    threads: int = 0
    """Of torch; 0: one per core."""
    seconds: float = 0.3
    """Of the repeats of a point."""
    minutes: float = 5.0
    """Points that would begin later are left out."""


SHIPPED = ModelSize("shipped", "cpu_full", (64, 128), shipped_px=64)
LARGE, SMALL = ModelSize("gpu", "gpu", (64, 128)), ModelSize("smoke", "smoke", (64, 128))
GPU_PLAN = Plan(
    models=(SHIPPED, LARGE), envs=(64, 256, 1024, 4096), loop_envs=(64,),
    trained=(SHIPPED, LARGE), batch_shares=(0.25, 1.0),
)
CPU_PLAN = Plan(
    models=(replace(SHIPPED, sizes_px=(64,)), SMALL), envs=(64,), loop_envs=(64,), trained=(SHIPPED, SMALL),
    batch_shares=(0.125,), iterations=4, captured=False, threads=1,
)
"""The same code where there is no GPU, or for a first look at one."""


@dataclass(frozen=True)
class Stopwatch:
    """Wall time of work on `device`, which is waited for."""

    device: torch.device
    seconds: float

    def once(self, work: Callable[[], object]) -> float:
        synchronize(self.device)
        start = time.perf_counter()
        work()
        synchronize(self.device)
        return time.perf_counter() - start

    def repeats(self, work: Callable[[], object]) -> list[float]:
        """Seconds of each repeat, for `seconds` together; a first one warms up and does not count."""
        found: list[float] = []
        self.once(work)
        while len(found) < MOST_REPEATS and (
            sum(found) < self.seconds or (len(found) < FEWEST_REPEATS and sum(found) < 10 * self.seconds)
        ):
            found.append(self.once(work))
        return found


@dataclass(frozen=True)
class Point:
    """One measurement."""

    group: str
    """Of the results."""
    what: Mapping[str, Any]
    """The columns that name it among those of its group."""
    unit: str
    """Of its values."""
    measure: Callable[[Stopwatch], Sequence[float] | Mapping[str, float]]
    """Returns the values of its repeats, or several named numbers."""

    @property
    def name(self) -> str:
        return f"{self.group}: {described(self.what)}"


class Suite:
    """Measures points. results: {group: [numbers]}; skipped: [point, reason]; state: RUNNING, INTERRUPTED or FINISHED.

    A point that fails does not end the others: `failed` then. Ctrl-C keeps what was measured.

    Args:
        say: is told each line of progress. keep: is called after every point, to save what there is.
    """

    def __init__(
        self, device: torch.device, plan: Plan, say: Callable[[str], None],
        keep: Callable[["Suite"], None] = lambda suite: None,
    ) -> None:
        self.device, self.plan, self.say, self._keep = device, plan, say, keep
        self.results: dict[str, list[dict[str, Any]]] = {}
        self.skipped: list[dict[str, str]] = []
        self.state, self.failed = RUNNING, False
        self._watch, self._began = Stopwatch(device, plan.seconds), time.monotonic()

    @property
    def spent_s(self) -> float:
        return time.monotonic() - self._began

    def run(self, points: Sequence[Point]) -> None:
        self.results |= {point.group: [] for point in points if point.group not in self.results}
        handled = 0
        try:
            for point in points:
                outcome = self._reason_to_skip(point) or self._measure(point)
                handled += 1
                self.say(f"{self.spent_s:4.0f} s  {handled:2}/{len(points)}  {point.name}: {outcome}")
                self._keep(self)
            self.state = FINISHED
        except KeyboardInterrupt:
            self.state = INTERRUPTED
            self.skipped += [{"point": left.name, "reason": "interrupted"} for left in points[handled:]]
            self.say(f"interrupted; {len(points) - handled} of {len(points)} points are left out")

    def _measure(self, point: Point) -> str:
        self._restart_peak()
        try:
            found = point.measure(self._watch)
        except (torch.OutOfMemoryError, MemoryError):
            return self._skip(point, f"the memory of {self.device} is too small")
        except NOT_HERE as error:
            return self._skip(point, " ".join(str(error).split()))
        except Exception as error:  # the rest of a short time with a GPU is worth more than an early end
            self.failed = True
            return self._skip(point, f"failed: {error!r}"[:300], traceback=traceback.format_exc()[-LAST_LINES:])
        finally:
            gc.collect()
            peak = self._peak()
        numbers = dict(found) if isinstance(found, Mapping) else spread(found)
        self.results[point.group].append(
            {"point": described(point.what), **point.what, **numbers, "unit": point.unit, "peak_mib": peak}
        )
        shown = "median" if "median" in numbers else next(iter(numbers))
        return f"{number_text(numbers[shown])} {point.unit}"

    def _reason_to_skip(self, point: Point) -> str:
        if self.spent_s > 60 * self.plan.minutes:
            return self._skip(point, f"the {self.plan.minutes:g} minutes were over")
        return ""

    def _skip(self, point: Point, reason: str, **more: str) -> str:
        self.skipped.append({"point": point.name, "reason": reason, **more})
        return f"left out: {reason}"

    def _restart_peak(self) -> None:
        if self.device.type == CPU:
            restart_peak()
            return
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(self.device)

    def _peak(self) -> float:
        if self.device.type == CPU:
            return memory_mib("VmHWM")
        return torch.cuda.max_memory_allocated(self.device) / 2**20


def described(what: Mapping[str, Any]) -> str:
    """The columns that name a point, as one text."""
    return ", ".join(WORDS.get(key, "{}").format(value) for key, value in what.items())


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, 10 % and 90 % quantiles, and number of the values."""
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    return {"median": middle, "p10": low, "p90": high, "n": len(values)}


def spread_text(row: Mapping[str, Any]) -> str:
    """The median, and half the distance of the quantiles as a share of it."""
    middle, half = row["median"], (row["p90"] - row["p10"]) / 2
    return number_text(middle) + (f" ±{100 * half / middle:.0f} %" if row["n"] > 1 else "")


def number_text(value: float) -> str:
    """Three digits, with thousands apart."""
    if value != value or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"
