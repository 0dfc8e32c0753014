"""Table 1 of RoboScape-R at the size of this repository: the same clones, trained by RL in the simulator and in the
world model, and measured in and out of domain.

A clone has seen demonstrations of one scene alone. IND is that scene, OOD the mean of ood_object and ood_combo.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, get_args

from benchmarks.environments.experiments import Configured, is_finished
from benchmarks.environments.learned_rewards import EMBEDDING, PROXY, Learned, environment_paid_by
from benchmarks.environments.policies import SIMULATOR, WORLD_MODEL, Workplace, rate_of, train_on
from benchmarks.experiment import console
from benchmarks.video_rl.comparison import paired_interval
from wm_nodes.apps.seed_study import mean_gain
from wm_nodes.config.load import load_config
from wm_nodes.config.scenes import draw, splits
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.progress import tqdm
from wm_nodes.reports.console_table import make_table
from wm_nodes.world_model import ImaginedEpisodes

TASKS = ("pick_place", "push", "pull", "move_to_aim")
Training = Literal["sft", "one_scene", "all_scenes", "world_model", "embedding", "proxy"]
SFT, ONE_SCENE, ALL_SCENES, MODEL, *_ = get_args(Training)
LABELS = {
    SFT: "SFT", ONE_SCENE: "RL in the simulator, its scene", ALL_SCENES: "RL in the simulator, all training scenes",
    MODEL: "RL in the world model", "embedding": "the same, an embedding head pays",
    "proxy": "the same, a proxy network pays",
}
LEARNED: dict[str, Learned] = {"embedding": EMBEDDING, "proxy": PROXY}
LEARNED_FROM = 200
"""Simulator episodes in training scenes that a learned reward has seen."""
OOD, TRAIN = ("ood_object", "ood_combo"), "train"
PAPER = {
    (SFT, "IND"): (12.0, 84.5, 57.7, 35.8), (SFT, "OOD"): (3.5, 13.3, 10.2, 10.6),
    (ONE_SCENE, "IND"): (85.0, 98.5, 64.2, 87.6), (ONE_SCENE, "OOD"): (32.1, 15.6, 15.5, 42.9),
    (MODEL, "IND"): (86.7, 98.7, 65.2, 88.1), (MODEL, "OOD"): (74.2, 87.3, 51.3, 72.0),
}
"""The paper's cells of its MLP policy, %, in the order of TASKS."""


def scene_of_seed(seed: int) -> str:
    """The training scene whose demonstrations the clone of a seed has seen."""
    scenes = splits()[TRAIN]
    return scenes[draw(f"own scene {seed}", len(scenes))]


@dataclass(kw_only=True)
class RoboScape(Configured):
    """Table 1 of RoboScape-R: success of a policy cloned in one scene, after RL in the simulator on that scene, on all
    training scenes, and in the world model; measured in its scene (IND), with unseen objects and in unseen combinations
    (OOD). What --json holds is not trained again."""

    preset: str = "fair_start"
    """Of the settings: a name, or a .yaml."""
    tasks: tuple[str, ...] = TASKS
    """Columns."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Each has demonstrations and a scene of its own."""
    trainings: tuple[Training, ...] = (SFT, ONE_SCENE, ALL_SCENES, MODEL)
    """Rows: the clone, and RL from it in the simulator on its scene, there on all training scenes, or in the model; or
    there paid by a reward that was learned from success, as iVideoGPT's head or DiWA's network (Figure 2)."""
    work: Path = Path("runs/roboscape")
    """Folder of first frames and policies; what is there is kept."""

    def run(self) -> None:
        rows, shown = self.read(), list[dict[str, Any]]()
        cells = [(task, seed, name) for task in self.tasks for seed in self.seeds for name in self.trainings]
        for task, seed, training in tqdm(cells, desc="cells", unit="cell"):
            own = scene_of_seed(seed)
            workplace = self.workplace(task, seed, own)
            wanted = {**workplace.identity(SIMULATOR, (own, *OOD)), "model": training, "task": task, "seed": seed}
            if not is_finished(rows, wanted):
                rows.append({**wanted, **_cell(workplace, training, own, self.work)})
                self.write({"rows": rows}, device=workplace.config.device)
            shown += [row for row in rows if is_finished([row], wanted)]
        self._show(shown)

    def workplace(self, task: str, seed: int, own: str) -> Workplace:
        given = {"sft.scenes": own, **self.settings, "task": task, "seed": seed}
        config = load_config(self.preset, given)
        return Workplace(config, self.model_dir or shipped_model(task), self.work.absolute() / f"{task}_{seed}")

    def _show(self, rows: Sequence[dict[str, Any]]) -> None:
        columns = [(task, domain) for task in self.tasks for domain in ("IND", "OOD")]
        lines = []
        for training in self.trainings:
            found = [[row for row in rows if (row["model"], row["task"]) == (training, task)] for task, _ in columns]
            cells = (cell(of, domain) for of, (_, domain) in zip(found, columns, strict=True))
            lines.append((LABELS[training], *cells))
            lines.append(("  paper", *(_paper(training, task, domain) for task, domain in columns)))
        names = [f"{task} {domain}" for task, domain in columns]
        console.print(make_table("success, %; in brackets: the model is not accepted", ("", *names), lines))
        for base in (ONE_SCENE, ALL_SCENES):
            if text := gain(rows, base):
                console.print(f"OOD, {LABELS[MODEL]} less {LABELS[base]}, mean over tasks: {text} points")


def _cell(workplace: Workplace, training: str, own: str, work: Path) -> dict[str, Any]:
    """Train one policy and measure it in every column."""
    config, policy, report = workplace.config, workplace.policy(), None
    imagined: ImaginedEpisodes | None = None
    if training == MODEL or training in LEARNED:
        imagined = workplace.environment(WORLD_MODEL)
        before = workplace.imagined(policy, imagined)
        report = workplace.acceptance(WORLD_MODEL, policy, before, workplace.real(policy, TRAIN))
    if training in LEARNED:
        imagined = environment_paid_by(LEARNED[training], workplace, LEARNED_FROM, work)
    course = list[float]()
    if training != SFT:
        words = f"{config.task}, seed {config.seed}, {LABELS[training]}"
        with tqdm(total=config.ppo.updates, desc=words, unit="update") as bar:
            for success_rate in train_on(workplace, policy, imagined, own if training == ONE_SCENE else TRAIN):
                course.append(success_rate)
                bar.update()
    found = {name: workplace.real(policy, name) for name in (own, *OOD)}
    return {
        "scene": own, "course": course,
        **({} if report is None else {"accepted": report.passed, "acceptance": report.to_dict()}),
        "success": {
            name: {**rate_of(result), "episodes_won": result.success.astype(int).tolist()}
            for name, result in found.items()
        },
    }


def success_of(row: dict[str, Any], domain: str) -> float:
    """Success in a domain, %."""
    names = (row["scene"],) if domain == "IND" else OOD
    return 100 * fmean(row["success"][name]["rate"] for name in names)


def cell(rows: Sequence[dict[str, Any]], domain: str) -> str:
    """Mean over seeds, with its t interval (inside 0 to 100) where there are several; in brackets where the model is
    not accepted."""
    if not rows:
        return ""
    rates = [success_of(row, domain) for row in rows]
    text = f"{fmean(rates):.1f}"
    if len(rates) > 1:
        over = paired_interval(rates)
        text = f"{text} ({max(0.0, over.low):.1f} to {min(100.0, over.high):.1f})"
    return text if all(row.get("accepted", True) for row in rows) else f"[{text}]"


def gain(rows: Iterable[dict[str, Any]], base: str) -> str:
    """The paper's headline by its formula, mean_gain, over the tasks and seeds that both have; "" without any."""
    rates = {(row["seed"], row["model"], row["task"]): success_of(row, "OOD") for row in rows}
    both = [(seed, task) for seed, name, task in rates if name == MODEL and (seed, base, task) in rates]
    of_seeds = [
        mean_gain({(str(seed), name, task): rates[seed, name, task] for one, task in both if one == seed
                   for name in (MODEL, base)}, MODEL, base)
        for seed in sorted({seed for seed, _ in both})
    ]
    if not of_seeds:
        return ""
    text = f"{fmean(of_seeds):+.1f}"
    if len(of_seeds) > 1:
        over = paired_interval(of_seeds)
        text = f"{text} ({over.low:+.1f} to {over.high:+.1f} over {len(of_seeds)} seeds)"
    return text


def _paper(training: str, task: str, domain: str) -> str:
    cells = PAPER.get((training, domain))
    return f"{cells[TASKS.index(task)]:.1f}" if cells and task in TASKS else ""
