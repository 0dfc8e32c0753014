"""Trainings of several samplers at several seeds: run, kept in one file, compared."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from pydantic import TypeAdapter

from benchmarks.experiment import Count, OnDevice, console, rounded
from benchmarks.video_rl import tables
from benchmarks.video_rl.comparison import MEASURES, SamplerComparison, compare_samplers
from benchmarks.video_rl.samplers import SamplerSetup
from benchmarks.video_rl.trials import Plan, SamplerTrial
from wm_nodes.apps.options import prepare_torch
from wm_nodes.core.progress import tqdm
from wm_nodes.training.contents import content_of
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder

T = TypeVar("T")
OnIteration = Callable[[], object]


@dataclass(kw_only=True)
class Trainings(OnDevice, Generic[Plan]):
    """Train several samplers at several seeds, and compare them in pairs of one seed; what --json holds is not trained
    again."""

    seeds: tuple[int, ...] = (0, 1, 2)
    """A training of each sampler for each."""
    samplers: tuple[str, ...] = ()
    """Names of those to train; without, all."""
    workers: Count = 1
    """Trainings at the same time, a process each."""

    measures: ClassVar[Sequence[str]] = MEASURES
    """What the pairs are compared by."""

    def trials(self) -> list[SamplerTrial[Plan]]:
        """Everything that can be trained."""
        raise NotImplementedError

    def train(self, trial: SamplerTrial[Plan], seed: int, on_iteration: OnIteration) -> dict[str, Any]:
        """The row of a trial at a seed."""
        raise NotImplementedError

    def base(self) -> dict[str, Any]:
        """Which model training begins with, and which recordings it has."""
        raise NotImplementedError

    def pairs(self, rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
        """Which samplers are compared: (name, name of the other); every one with every CPS sampler."""
        names = sorted({row["sampler"] for row in rows})
        return [(name, base) for name in names for base in names if base.startswith("CPS") and name != base]

    def show(self, rows: list[dict[str, Any]], comparisons: list[SamplerComparison]) -> None:
        """Print the tables."""
        console.print(tables.gain_table(rows), tables.comparison_table(comparisons))

    def run(self) -> None:
        """Train, compare, show."""
        rows = self.train_all()
        compared = (compare_samplers(rows, one, other, self.measures) for one, other in self.pairs(rows))
        comparisons = [comparison for comparison in compared if comparison is not None]
        self.write_rows(rows, comparisons)
        self.show(rows, comparisons)

    def train_all(self) -> list[dict[str, Any]]:
        """The rows of the chosen trials at every seed, each with what it was made by; the file is written after each
        training."""
        trials, base = self.trials(), self.base()
        made_by = {trial.sampler.name: made_of(trial, base) for trial in trials}
        rows = self._finished(made_by, base)
        done = {(row["sampler"], row["seed"]) for row in rows}
        wanted = select({trial.sampler.name: trial for trial in trials}, self.samplers)
        todo = [(trial, seed) for seed in self.seeds for trial in wanted if (trial.sampler.name, seed) not in done]
        with tqdm(total=sum(trial.plan.iterations for trial, _ in todo), desc="trainings", unit="buffer") as bar:
            if self.workers > 1:
                with ProcessPoolExecutor(
                    self.workers, mp_context=get_context("spawn"), initializer=prepare_torch
                ) as pool:
                    futures = {pool.submit(self.train, trial, seed, _unseen): trial for trial, seed in todo}
                    for future in as_completed(futures):
                        trial = futures[future]
                        rows.append({**future.result(), **made_by[trial.sampler.name]})
                        bar.update(trial.plan.iterations)
                        self.write_rows(rows)
                return rows
            for trial, seed in todo:
                bar.set_postfix_str(f"{trial.sampler.name}, seed {seed}")
                rows.append({**self.train(trial, seed, bar.update), **made_by[trial.sampler.name]})
                self.write_rows(rows)
        return rows

    def write_rows(self, rows: list[dict[str, Any]], comparisons: Sequence[SamplerComparison] = ()) -> None:
        """The rows, the resolved settings of their samplers, and the comparisons."""
        names = {row["sampler"] for row in rows}
        setups = settings_of([trial.sampler for trial in self.trials() if trial.sampler.name in names])
        self.write({**self.base(), **setups, "comparisons": list(map(asdict, comparisons)), "rows": rows})

    def _finished(self, made_by: Mapping[str, Mapping[str, Any]], base: Mapping[str, Any]) -> list[dict[str, Any]]:
        """The rows of an earlier call; one that begins with another base, or a trial of this call that it ran by
        another setup or plan, is refused."""
        rows = self.read()
        if any("sampler" not in row for row in rows):
            raise ValueError(f"{self.json} holds rows of another experiment; take another file")
        for row in rows:
            name = row["sampler"]
            for part, wanted in made_by.get(name, rounded({"base": base})).items():
                if row.get(part) != wanted:
                    raise ValueError(
                        f"{self.json} holds {name} by another {part} ({_difference(row.get(part), wanted)}); take "
                        "another file"
                    )
        return rows


@dataclass(kw_only=True)
class RecordedTrainings(Trainings[Plan]):
    """Trainings on recordings that are given."""

    context_bags: tuple[Path, ...]
    """Recorded episodes to train on."""
    heldout_bags: tuple[Path, ...]
    """And those held out."""
    video_model: Path
    """Folder that training begins with."""
    learning_rate: float | None = None
    """Of every sampler, to choose one; without, the chosen ones."""

    def base(self) -> dict[str, Any]:
        recordings = recordings_of(self.context_bags, self.heldout_bags)
        return {"sha256": self.folder().manifest["sha256"], "recordings": recordings}

    def folder(self) -> VideoFolder:
        return load_video_folder(self.video_model, self.where)

    def recordings(self, folder: VideoFolder, most: int) -> tuple[Clips, Clips]:
        """Clips of the bags to train on, and the first `most` held-out ones."""
        contexts, heldout = (load_clips(bags, folder.clip["stride"]) for bags in (self.context_bags, self.heldout_bags))
        return contexts, heldout.first(most)

    def with_rate(self, setups: list[SamplerSetup]) -> list[SamplerSetup]:
        """The samplers with the learning rate that was given."""
        if not self.learning_rate:
            return setups
        return [replace(one, grpo=one.grpo.with_values(learning_rate=self.learning_rate)) for one in setups]


def recordings_of(context_bags: Sequence[Path], heldout_bags: Sequence[Path]) -> dict[str, list[str]]:
    """What bags are known by: their content, for they may be moved."""
    both = {"contexts": context_bags, "heldout": heldout_bags}
    return {name: [content_of(str(bag)) or str(bag) for bag in bags] for name, bags in both.items()}


def training_name(sampler: str, seed: int) -> str:
    """Sampler and seed, as a file's name."""
    return f"{sampler.replace(',', '').replace(' ', '_')}_{seed}"


def settings_of(samplers: list[SamplerSetup]) -> dict[str, Any]:
    return {"samplers": TypeAdapter(list[SamplerSetup]).dump_python(samplers)}


def made_of(trial: SamplerTrial[Plan], base: Mapping[str, Any]) -> dict[str, Any]:
    """What a row of the trial is made by, as a file holds it: plan, setup of the sampler, base."""
    setup = TypeAdapter(SamplerSetup).dump_python(trial.sampler)
    return rounded({"plan": asdict(trial.plan), "setup": setup, "base": base})


def select(known: dict[str, T], names: Sequence[str]) -> list[T]:
    """Those of the names; without any, all."""
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"unknown samplers {', '.join(unknown)}; choose among: {'; '.join(known)}")
    return [known[name] for name in names or known]


def _difference(found: Any, wanted: Any, name: str = "") -> str:
    """What differs, by dotted name: what a file holds, and what this call has."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        names = [key for key in {**found, **wanted} if found.get(key) != wanted.get(key)]
        return "; ".join(_difference(found.get(key), wanted.get(key), f"{name}.{key}".strip(".")) for key in names)
    return f"{name} {found}, this call has {wanted}".strip() if found is not None else f"{name} not recorded".strip()


def _unseen() -> None:
    """Progress within a training of another process."""
