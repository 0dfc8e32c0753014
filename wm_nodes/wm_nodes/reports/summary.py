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
    """Successes of `episodes` episodes; low, high: 95 % interval of the rate."""

    successes: int
    episodes: int
    low: float = 0.0
    high: float = 1.0

    def __post_init__(self) -> None:
        if self.episodes < 1 or not 0 <= self.successes <= self.episodes:
            raise ValueError(f"a rate needs 0 <= successes <= episodes >= 1, got {self.successes} of {self.episodes}")

    @property
    def rate(self) -> float:
        return self.successes / self.episodes


@dataclass(frozen=True)
class Summary:
    """The results of a run.

    real_, imagined_: success before and after training, in evaluation.environment and in the world model; None where
        evaluation.environment is none.
    imagined_steps_per_s: environment steps of the training in the world model, per second of training.
    bag: path of the recorded training, in the file relative to the run folder.
    paired, imagined_paired: after minus before on the same seeds, with the keys difference, low and high (and more);
        empty where not measured.
    acceptance: AcceptanceReport.to_dict(). samples: environment steps trained on. minutes: of the whole run,
    as first done. command: as typed. machine: facts by name.
    exploit_meter: one mapping for each reading, in order: step (updates made before it) and the numbers of
        policy_rl.exploit_meter.ExploitReading.metrics(). stopped: why training ended before all updates, by round.
    by_task: of a task whose every episode is one of several, the real success of each: successes_before and _after,
        episodes, difference, low and high.
    reward: that the policy was trained for. judge: who gave it, where it is the agent's; else empty.
    rounds: of a run in online rounds, one mapping for each: number, updates, samples, imagined_before, imagined, real
        (successes, episodes, low, high, rate), verdict (accepted, reason, rows; empty after the last). The imagined
        rates of a round are those of the model it trained in, so imagined_before and _after above may be of two models.
    """

    task: str
    preset: str
    seed: int
    real_before: SuccessRate | None
    real_after: SuccessRate | None
    imagined_before: SuccessRate
    imagined_after: SuccessRate
    imagined_steps_per_s: float
    bag: str
    paired: Mapping[str, Any] = field(default_factory=dict)
    imagined_paired: Mapping[str, Any] = field(default_factory=dict)
    acceptance: Mapping[str, Any] = field(default_factory=dict)
    samples: int = 0
    minutes: float = float("nan")
    command: str = ""
    machine: Mapping[str, str] = field(default_factory=dict)
    rounds: Sequence[Mapping[str, Any]] = ()
    exploit_meter: Sequence[Mapping[str, Any]] = ()
    stopped: Sequence[str] = ()
    by_task: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    reward: str = "endogenous"
    judge: str = ""


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
    """The outcome of an AcceptanceReport.to_dict(), or of one of its criteria; earlier versions had only `passed`."""
    return str(report.get("outcome") or ("passed" if report["passed"] else "failed"))


def read_summary(run_dir: Path) -> dict[str, Any]:
    """The values of <run_dir>/summary.json, with the path of the bag as bag_path() says; `acceptance` is called gate in
    older ones.

    Raises:
        FileNotFoundError: the run has not ended; names the file.
    """
    path = Path(run_dir) / FILE_NAME
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: the run has not come to its end")
    values = read_json(path, AGAIN)
    values["bag"] = bag_path(run_dir, values.get("bag", ""))
    return {"acceptance" if name == "gate" else name: value for name, value in values.items()}


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
