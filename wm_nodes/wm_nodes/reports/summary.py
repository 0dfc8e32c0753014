"""The numbers of one run, as plain data, and summary.json."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import AGAIN, read_json
from wm_nodes.training.metrics import read_metrics

FILE_NAME = "summary.json"
OF_THE_CALL = ("minutes", "command", "machine", "date")
"""What a summary says of the call that made the results, not of them."""


@dataclass(frozen=True)
class SuccessRate:
    """Successes of some episodes."""

    successes: int
    """Of the episodes."""
    episodes: int
    """At least 1."""
    low: float = 0.0
    """Of the 95 % interval of the rate."""
    high: float = 1.0
    """Of the 95 % interval of the rate."""

    def __post_init__(self) -> None:
        if self.episodes < 1 or not 0 <= self.successes <= self.episodes:
            raise ValueError(f"a rate needs 0 <= successes <= episodes >= 1, got {self.successes} of {self.episodes}")

    @property
    def rate(self) -> float:
        return self.successes / self.episodes


@dataclass(frozen=True)
class Summary:
    """The results of a run."""

    task: str
    """By name."""
    preset: str
    """That the settings began with."""
    seed: int
    """Of every random number."""
    real_before: SuccessRate | None
    """Success in evaluation.environment before training; None where that is none."""
    real_after: SuccessRate | None
    """And after."""
    imagined_before: SuccessRate
    """Success in the world model before training."""
    imagined_after: SuccessRate
    """And after."""
    imagined_steps_per_s: float
    """Environment steps of the training in the world model, per second of training; NaN: not timed."""
    bag: str
    """Path of the recorded training, in the file relative to the run folder."""
    paired: Mapping[str, Any] = field(default_factory=dict)
    """Real success after minus before on the same seeds: difference, low, high (and more); empty: not measured."""
    imagined_paired: Mapping[str, Any] = field(default_factory=dict)
    """The same of imagined success."""
    acceptance: Mapping[str, Any] = field(default_factory=dict)
    """AcceptanceReport.to_dict()."""
    samples: int = 0
    """Environment steps trained on."""
    minutes: float = float("nan")
    """Of the whole run, as first done."""
    command: str = ""
    """As typed."""
    machine: Mapping[str, str] = field(default_factory=dict)
    """Facts by name."""
    rounds: Sequence[Mapping[str, Any]] = ()
    """Of a run in online rounds, in order: number, updates, samples, imagined_before, imagined, real (successes,
    episodes, low, high, rate), verdict (accepted, reason, rows; empty after the last). The imagined rates of a round
    are those of the model it trained in, so imagined_before and imagined_after above may be of two models."""
    exploit_meter: Sequence[Mapping[str, Any]] = ()
    """Readings in order: step (updates made before) and the numbers of ExploitReading.metrics()."""
    stopped: Sequence[str] = ()
    """Why training ended before all updates, by round."""
    by_task: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of a task whose every episode is one of several, the real success of each: successes_before, successes_after,
    episodes, difference, low and high."""
    reward: str = "endogenous"
    """That the policy was trained for."""
    judge: str = ""
    """Who gave it, where it is the agent's; else empty."""


def write_summary(run_dir: Path, summary: Any) -> Path:
    """Write <run_dir>/summary.json, complete or not at all, unless it says so already; a number that is not finite
    becomes null, and a bag in the run folder is named from there, so that the folder can be moved."""
    path, values = Path(run_dir) / FILE_NAME, _values(summary)
    bag, folder = Path(summary.bag).absolute(), Path(run_dir).absolute()
    if summary.bag and bag.is_relative_to(folder):
        values["bag"] = str(bag.relative_to(folder))
    data = (json.dumps(values, indent=1, allow_nan=False) + "\n").encode()
    if not (path.is_file() and path.read_bytes() == data):
        write_atomic(path, data)
    return path


def acceptance_outcome(report: Mapping[str, Any]) -> str:
    """The outcome of an AcceptanceReport.to_dict(), or of one of its criteria."""
    return str(report["outcome"])


def read_summary(run_dir: Path) -> dict[str, Any]:
    """The values of <run_dir>/summary.json, with the path of the bag as bag_path() says.

    Raises:
        FileNotFoundError: the run has not ended; names the file.
    """
    path = Path(run_dir) / FILE_NAME
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: the run has not come to its end")
    values: dict[str, Any] = read_json(path, AGAIN)
    values["bag"] = bag_path(run_dir, values.get("bag", ""))
    return values


def as_first_made(run_dir: Path, summary: Any) -> Any:
    """The summary of a run that was done before and gave the same results: with the duration, command, machine and date
    of the call that made them. Of another run: as it is. In both, the bag as bag_path() says."""
    summary = replace(summary, bag=bag_path(run_dir, summary.bag))
    if not (Path(run_dir) / FILE_NAME).is_file():
        return summary
    kept, values = read_summary(run_dir), _values(summary)
    call = {name: kept[name] for name in OF_THE_CALL if name in kept and name in values}
    if kept != {**values, **call}:
        return summary
    return replace(summary, **{name: math.nan if value is None else value for name, value in call.items()})


def bag_path(run_dir: Path, bag: str) -> str:
    """The path of a run's bag, which may be relative to the run folder; where that was moved since, the bag of the same
    name in it. "" without a bag."""
    path, moved = Path(run_dir, bag), Path(run_dir) / "bags" / Path(bag).name
    return str((moved if not path.exists() and moved.exists() else path).absolute()) if bag else ""


def _values(summary: Any) -> dict[str, Any]:
    values: dict[str, Any] = plain(asdict(summary))
    for name, value in vars(summary).items():
        if isinstance(value, SuccessRate):
            values[name]["rate"] = value.rate
    return values


def read_readings(run_dir: Path) -> list[dict[str, Any]]:
    """The exploit meter's readings in a run's metrics, of each step the last: a resumed run may have repeated one."""
    lines: dict[Any, dict[str, Any]] = {line["step"]: line for line in read_metrics(run_dir, "exploit_meter")}
    return [{name: lines[step][name] for name in lines[step] if name != "section"} for step in sorted(lines)]


def plain(value: Any) -> Any:
    """The value as JSON can hold it: mappings and lists of plain values, None for a number that is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, bool) or value is None or isinstance(value, (str, int)):
        return value
    number = float(value)
    return number if math.isfinite(number) else None
