"""Online rounds: train in the world model, collect with the policy in the simulator, refresh the model, go on.

Each round has a folder of its own, <run>/rounds/<k>: the learner's checkpoint, the policy's versions, the evaluations,
the bags of the policy and the refreshed model. `result.json` is written last; a round that has it is skipped. One round
(the default) trains in the run folder itself and collects nothing. The policy goes on from round to round; the learner
starts anew in each: its optimiser, its critic-only updates (ppo.value_warmup_updates), and the policy that
ppo.kl_reference_weight keeps it close to, which is the one the round started from.
"""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Table

from wm_nodes.apps import policy_run
from wm_nodes.apps.policy_run import RunContext, TrainingResult, TrainingStart, WaitingGraph, read_success
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import AGAIN, read_json
from wm_nodes.core.types import BoolArray
from wm_nodes.policy_rl import model_refresh
from wm_nodes.policy_rl.model_refresh import RefreshDecision
from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.stages import console
from wm_nodes.reports.summary import plain
from wm_nodes.training.metrics import join_metrics
from wm_nodes.world_model import load_model_folder

RESULT = "result.json"
Judge = Callable[[BoolArray, BoolArray | None], None]
"""(imagined, real success of the starting policy) -> None; may raise to refuse the training. None: not measured."""


@dataclass(frozen=True)
class ModelRefreshLoop:
    """What a run's rounds gave."""

    policy: Path
    """The weights after the last round."""
    model_dir: Path
    """What they were trained in."""
    real_before: BoolArray | None
    """Success in evaluation.environment before the first round, bool (E,); None where that is none."""
    real_after: BoolArray | None
    """The same after the last round."""
    imagined_before: BoolArray
    """Success in the first round's model before that round, bool (E,)."""
    imagined_after: BoolArray
    """Success in the last round's model after that round, bool (E,)."""
    samples: int
    """Transitions of all rounds."""
    samples_per_s: float
    """Mean of the rounds that were timed; NaN where none was."""
    bag: str
    """Of the last round's training."""
    table: tuple[dict[str, Any], ...]
    """A row for each round, as in summary.json; empty where there was one round only."""
    stopped: tuple[str, ...] = ()
    """Why rounds ended before all their updates."""
    bag_is_whole: bool = True
    """Whether `bag` holds every update that the policy has had."""


def round_start(job: RunContext, number: int, model_dir: Path, policy: Path) -> TrainingStart:
    """What round `number`, counted from 1, begins with."""
    part = model_refresh.round_of(job.config, job.run_dir, number, model_dir, job.starts)
    several = job.config.model_refresh.num_rounds > 1
    folder, label = (part.folder, f"round {number}") if several else (job.run_dir, "")
    return TrainingStart(folder, model_dir, policy, part.config, part.starts, label)


def run_rounds(
    job: RunContext, model_dir: Path, policy: Path, judge: Judge, waiting: WaitingGraph | None = None
) -> ModelRefreshLoop:
    """Train `policy` in rounds, beginning in the world model `model_dir`; judge it first.

    waiting: the processes of round 1, where they run already.
    """
    num_rounds = job.config.model_refresh.num_rounds
    starts, trainings, table = list[TrainingStart](), list[TrainingResult](), list[dict[str, Any]]()

    def train(part: model_refresh.Round) -> bool:
        weights = trainings[-1].policy(starts[-1].folder) if starts else policy
        start = round_start(job, part.number, part.model_dir, weights)
        if num_rounds > 1:
            job.stage(f"round {part.number} of {num_rounds}: {part.config.ppo.updates} updates in {part.model_dir}")
        imagined = policy_run.imagined_success(job, start.folder, "before", part.model_dir, start.policy)
        first_only = (partial(judge, imagined), waiting) if part.number == 1 else ()
        trained = policy_run.train_round(job, start, *first_only)
        policy_run.imagined_success(job, start.folder, "after", part.model_dir, trained.policy(start.folder))
        starts.append(start)
        trainings.append(trained)
        if num_rounds > 1:
            table.append(_finish(job, start, trained, part.number, last=part.last))
        return bool(table and table[-1]["verdict"].get("accepted"))

    model_refresh.run_rounds(job.config, job.run_dir, model_dir, job.starts, train)
    first, last = starts[0], starts[-1]
    speeds = [trained.samples_per_s for trained in trainings if math.isfinite(trained.samples_per_s)]
    if table:
        join_metrics([start.folder for start in starts], job.run_dir)
    return ModelRefreshLoop(
        trainings[-1].policy(last.folder), last.model_dir,
        read_success(first.folder, "real_before") if job.measures else None,
        read_success(last.folder, "real_after") if job.measures else None,
        read_success(first.folder, "imagined_before"), read_success(last.folder, "imagined_after"),
        sum(trained.samples for trained in trainings),
        sum(speeds) / len(speeds) if speeds else math.nan, trainings[-1].bag, tuple(table),
        tuple(
            f"{start.label}: {trained.stopped}".removeprefix(": ")
            for start, trained in zip(starts, trainings, strict=True) if trained.stopped
        ),
        len(trainings) == 1 and not trainings[0].resumed,
    )


def _finish(
    job: RunContext, start: TrainingStart, trained: TrainingResult, number: int, *, last: bool
) -> dict[str, Any]:
    """Measure a trained round, collect with its policy and refresh the model; the result as in summary.json."""
    marker = start.folder / RESULT
    if marker.is_file():
        return read_json(marker, AGAIN)
    policy = trained.policy(start.folder)
    measured = ("imagined_before", "imagined_after", "real_after")
    before, imagined, real = (policy_run.success_rate(read_success(start.folder, name)) for name in measured)
    job.stage(
        f"round {number}: imagined success {imagined.successes}/{imagined.episodes}, "
        f"real success {real.successes}/{real.episodes}"
    )
    verdict = None if last else _refresh(job, start, policy, number)
    result: dict[str, Any] = plain({
        "number": number, "updates": trained.updates, "samples": trained.samples,
        "model_sha256": load_model_folder(start.model_dir).sha256,
        "imagined_before": asdict(before) | {"rate": before.rate},
        "imagined": asdict(imagined) | {"rate": imagined.rate}, "real": asdict(real) | {"rate": real.rate},
        "verdict": {} if verdict is None else verdict.to_dict(),
    })
    write_atomic(marker, json.dumps(result, indent=1).encode())
    return result


def _refresh(job: RunContext, start: TrainingStart, policy: Path, number: int) -> RefreshDecision:
    verdict = model_refresh.refresh_round(
        job.config, start.model_dir, policy, job.starts, job.run_dir, number, say=job.stage
    )
    console.print(_verdict_table(verdict, number))
    words = "taken" if verdict.accepted else "NOT taken, the old one is kept"
    job.stage(f"refreshed model {words}: {verdict.reason}")
    return verdict


def _verdict_table(verdict: RefreshDecision, number: int) -> Table:
    rows = []
    for row in verdict.rows:
        word = "[red]worse" if row.worse else "[green]better" if row.better else ""
        rows.append((row.name, f"{row.old:.3f}", f"{row.new:.3f}", f"{row.low:+.3f} to {row.high:+.3f}", word))
    title = f"round {number}: the old and the refreshed model on the policy's held-out real episodes"
    return make_table(title, ("number", "old", "new", "new - old, 95 %", ""), rows, left=("number", ""))
