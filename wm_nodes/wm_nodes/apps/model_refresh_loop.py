"""Online rounds: train in the world model, collect with the policy in the simulator, refresh the model, go on.

Each round has a folder of its own, <run>/rounds/<k>: the learner's checkpoint, the policy's versions, the evaluations,
the bags of the policy and the refreshed model. `result.json` is written last; a round that has it is skipped. One round
(the default) trains in the run folder itself and collects nothing. The policy goes on from round to round; the learner
starts anew in each: its optimiser, its critic-only updates (ppo.value_warmup_updates), and the policy that
ppo.kl_reference_weight keeps it close to, which is the one the round started from.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Table

from wm_nodes.apps import policy_run
from wm_nodes.apps.policy_run import RunContext, TrainingResult, TrainingStart, WaitingGraph, console, read_success
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import AGAIN, read_json
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import BoolArray
from wm_nodes.policy_rl import model_refresh
from wm_nodes.policy_rl.model_refresh import RefreshDecision, round_folder, round_starts
from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.summary import plain
from wm_nodes.training.metrics import join_metrics
from wm_nodes.world_model import load_model_folder

RESULT = "result.json"
Judge = Callable[[BoolArray, BoolArray | None], None]
"""(imagined, real success of the starting policy) -> None; may raise to refuse the training. None: not measured."""


@dataclass(frozen=True)
class ModelRefreshLoop:
    """What a run's rounds gave. Success: bool (E,), before the first round in its model and after the last in its;
    real_, None where evaluation.environment is none.

    policy: the weights after the last round. model_dir: what it was trained in. samples, samples_per_s: all rounds'
    transitions, and their rate (mean of the rounds). bag: of the last round's training. table: one mapping for each
    round, as in summary.json; empty where there was one round only. stopped: why rounds ended before all their updates.
    """

    policy: Path
    model_dir: Path
    real_before: BoolArray | None
    real_after: BoolArray | None
    imagined_before: BoolArray
    imagined_after: BoolArray
    samples: int
    samples_per_s: float
    bag: str
    table: tuple[dict[str, Any], ...]
    stopped: tuple[str, ...] = ()


def split_updates(updates: int, rounds: int) -> list[int]:
    """Equal shares of the policy updates; the first rounds take the remainder.

    Raises:
        ValueError: a round would make none.
    """
    if rounds > 1 and updates < rounds:
        raise ValueError(f"ppo.updates is {updates}, fewer than {rounds} rounds; raise it or lower --rounds")
    share, remainder = divmod(updates, rounds)
    return [share + (number < remainder) for number in range(rounds)]


def round_start(job: RunContext, number: int, model_dir: Path, policy: Path) -> TrainingStart:
    """What round `number`, counted from 1, begins with."""
    shares = split_updates(job.config.ppo.updates, job.config.model_refresh.num_rounds)
    start = TrainingStart(_folder(job, number), model_dir, policy, job.config, job.starts)
    if len(shares) == 1:
        return start
    return replace(
        start, config=round_config(job.config, number, shares[number - 1]), label=f"round {number}",
        starts=round_starts(job.config, job.run_dir, number, job.starts),
    )


def run_rounds(
    job: RunContext, model_dir: Path, policy: Path, judge: Judge, waiting: WaitingGraph | None = None
) -> ModelRefreshLoop:
    """Train `policy` in rounds, beginning in the world model `model_dir`; judge it first.

    waiting: the processes of round 1, where they run already.
    """
    config = job.config
    shares = split_updates(config.ppo.updates, config.model_refresh.num_rounds)
    if len(shares) > 1:
        model_refresh.check_refreshable(model_dir)
    starts, trainings, table = list[TrainingStart](), list[TrainingResult](), list[dict[str, Any]]()
    for number, updates in enumerate(shares, 1):
        start = round_start(job, number, model_dir, policy)
        if len(shares) > 1:
            job.stage(f"round {number} of {len(shares)}: {updates} updates in {model_dir}")
        imagined = policy_run.imagined_success(job, start.folder, "before", model_dir, policy)
        first_only = (partial(judge, imagined), waiting) if number == 1 else ()
        trained = policy_run.train_round(job, start, *first_only)
        policy = trained.policy(start.folder)
        policy_run.imagined_success(job, start.folder, "after", model_dir, policy)
        starts.append(start)
        trainings.append(trained)
        if len(shares) > 1:
            table.append(_finish(job, start, trained, number, last=number == len(shares)))
            model_dir = start.folder / "model" if table[-1]["verdict"].get("accepted") else model_dir
    first, last = starts[0], starts[-1]
    if table:
        join_metrics([start.folder for start in starts], job.run_dir)
    return ModelRefreshLoop(
        policy, last.model_dir, read_success(first.folder, "real_before") if job.measures else None,
        read_success(last.folder, "real_after") if job.measures else None,
        read_success(first.folder, "imagined_before"), read_success(last.folder, "imagined_after"),
        sum(trained.samples for trained in trainings),
        sum(trained.samples_per_s for trained in trainings) / len(trainings), trainings[-1].bag, tuple(table),
        tuple(
            f"{start.label}: {trained.stopped}".removeprefix(": ")
            for start, trained in zip(starts, trainings, strict=True) if trained.stopped
        ),
    )


def _folder(job: RunContext, number: int) -> Path:
    return job.run_dir if job.config.model_refresh.num_rounds == 1 else round_folder(job.run_dir, number)


def round_config(config: RunConfig, number: int, updates: int) -> RunConfig:
    """The configuration of a round: its share of the updates, and from round 2 on a seed of its own, because every
    round's policy versions, from which the learner's random streams follow, begin at 1."""
    seed = config.seed if number == 1 else int(numpy_stream(config.seed, "round", number).integers(2**31))
    return config.model_copy(update={"seed": seed, "ppo": config.ppo.model_copy(update={"updates": updates})})


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
