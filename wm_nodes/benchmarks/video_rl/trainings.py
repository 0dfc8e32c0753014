"""Trainings of several samplers at several seeds: run, kept in one file, compared, drawn."""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import torch
from pydantic import TypeAdapter

from benchmarks.speed.results import write_results
from benchmarks.video_rl.comparison import MEASURES, SamplerComparison, compare_samplers
from benchmarks.video_rl.samplers import LearningPlan, SamplerSetup
from benchmarks.video_rl.sources import TASK
from benchmarks.video_rl.trials import Plan, SamplerTrial
from wm_nodes.apps.options import add_device, add_json, positive, prepare_torch
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.progress import tqdm
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder

T = TypeVar("T")


def add_training_options(
    parser: argparse.ArgumentParser, plan: type[LearningPlan], video_model: str, seeds: Sequence[int]
) -> None:
    """Of trainings on recordings. plan: its values are the defaults. video_model: folder beside the world model."""
    parser.add_argument("--video-model", type=Path, default=shipped_model(TASK) / video_model)
    parser.add_argument("--context-bags", type=Path, nargs="+", required=True, metavar="BAG")
    parser.add_argument("--heldout-bags", type=Path, nargs="+", required=True, metavar="BAG")
    parser.add_argument("--iterations", type=positive, default=plan.iterations)
    parser.add_argument("--eval-contexts", type=positive, default=plan.eval_contexts)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(seeds))
    parser.add_argument("--samplers", "--arms", nargs="+", metavar="NAME")
    parser.add_argument("--learning-rate", type=float, help="of every arm, to choose one; default: the chosen ones")
    parser.add_argument("--workers", type=positive, default=1, help="trainings at the same time, a process each")
    add_device(parser)
    add_json(parser, "write every row here; trainings go on where the file stops")


def with_rate(arms: list[SamplerSetup], learning_rate: float | None) -> list[SamplerSetup]:
    """The arms with another learning rate; None: with their own."""
    if not learning_rate:
        return arms
    return [replace(arm, grpo=arm.grpo.with_values(learning_rate=learning_rate)) for arm in arms]


def load_recordings(arguments: argparse.Namespace, folder: VideoFolder, most: int | None = None) -> tuple[Clips, Clips]:
    """Clips of the bags to train on, and the first `most` held-out ones; None: all."""
    bags = arguments.context_bags, arguments.heldout_bags
    contexts, heldout = (load_clips(some, folder.clip["stride"]) for some in bags)
    return contexts, heldout.select(torch.arange(len(heldout))[:most])


def train_all(
    arguments: argparse.Namespace, trials: list[SamplerTrial[Plan]],
    train: Callable[[SamplerTrial[Plan], int, Callable[[], object]], dict[str, Any]], of: dict[str, Any],
    workers: int = 1,
) -> list[dict[str, Any]]:
    """The trials named by --samplers, at every seed, but what --json holds already; it is written after each training.

    train: returns the row of a trial at a seed. of: what the file says beside the rows. workers: processes; with more
    than one, train must be picklable.
    """
    rows = finished(arguments.json, trials)
    done = {(row["sampler"], row["seed"]) for row in rows}
    wanted = select({trial.sampler.name: trial for trial in trials}, arguments.samplers)
    todo = [(trial, seed) for seed in arguments.seeds for trial in wanted if (trial.sampler.name, seed) not in done]
    with tqdm(total=sum(trial.plan.iterations for trial, _ in todo), desc=arguments.experiment, unit="buffer") as bar:
        if workers > 1:
            with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=prepare_torch) as pool:
                futures = {pool.submit(train, trial, seed, _unseen): trial for trial, seed in todo}
                for future in as_completed(futures):
                    rows.append(future.result())
                    bar.update(futures[future].plan.iterations)
                    write_trainings(arguments, trials, rows, [], of)
            return rows
        for trial, seed in todo:
            bar.set_postfix_str(f"{trial.sampler.name}, seed {seed}")
            rows.append(train(trial, seed, bar.update))
            write_trainings(arguments, trials, rows, [], of)
    return rows


def _unseen() -> None:
    """Progress within a training of another process."""


def row_name(row: Mapping[str, Any]) -> str:
    """Arm and seed of a row, as a file's name."""
    return f"{row['sampler'].replace(',', '').replace(' ', '_')}_{row['seed']}"


def against_cps(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Every sampler with every CPS sampler."""
    names = sorted({row["sampler"] for row in rows})
    return [(name, base) for name in names for base in names if base.startswith("CPS") and name != base]


def compare(
    arguments: argparse.Namespace, trials: Sequence[SamplerTrial[Any]], rows: list[dict[str, Any]],
    pairs: list[tuple[str, str]], of: dict[str, Any], measures: Sequence[str] = MEASURES,
) -> list[SamplerComparison]:
    """Compare each pair that has seeds in common, and write that beside the rows."""
    compared = (compare_samplers(rows, sampler, base, measures) for sampler, base in pairs)
    comparisons = [comparison for comparison in compared if comparison is not None]
    write_trainings(arguments, trials, rows, comparisons, of)
    return comparisons


def write_trainings(
    arguments: argparse.Namespace, trials: Sequence[SamplerTrial[Any]], rows: list[dict[str, Any]],
    comparisons: list[SamplerComparison], of: dict[str, Any],
) -> None:
    """The rows, the resolved settings of their samplers, and the comparisons."""
    names = {row["sampler"] for row in rows}
    samplers = settings_of([trial.sampler for trial in trials if trial.sampler.name in names])
    write_results(arguments, {**of, **samplers, "comparisons": list(map(asdict, comparisons)), "rows": rows})


def settings_of(samplers: list[SamplerSetup]) -> dict[str, Any]:
    return {"samplers": TypeAdapter(list[SamplerSetup]).dump_python(samplers)}


def select(known: dict[str, T], names: list[str] | None) -> list[T]:
    unknown = [name for name in names or [] if name not in known]
    if unknown:
        raise ValueError(f"unknown samplers {', '.join(unknown)}; choose among: {'; '.join(known)}")
    return [known[name] for name in names or known]


def finished(path: Path | None, trials: Sequence[SamplerTrial[Any]]) -> list[dict[str, Any]]:
    """The rows of an earlier call; a trial of this one that it ran by another plan is refused."""
    if path is None or not path.is_file():
        return []
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["rows"]
    if any("sampler" not in row for row in rows):
        raise ValueError(f"{path} is of an earlier version of this benchmark; take another file")
    plans = {trial.sampler.name: json.loads(json.dumps(asdict(trial.plan))) for trial in trials}
    for row in rows:
        plan, name = row["plan"], row["sampler"]
        if plan != plans.get(name, plan):
            raise ValueError(f"{path} holds {name} by plan {plan}, this call has {plans[name]}; take another file")
    return rows


def draw(arguments: argparse.Namespace, plot: Callable[..., None], what: Sequence[Any], *more: Any) -> None:
    """The picture beside the --json file, where there is one and something to draw."""
    if arguments.json is not None and what:
        plot(what, arguments.json.with_suffix(".png"), *more)
