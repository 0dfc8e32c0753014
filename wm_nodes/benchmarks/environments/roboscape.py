"""Tables 1 and 2, Figures 2, 3, 4 and 9 of RoboScape-R at the size of this repository: the same clones, trained by RL
in the simulator and in the world model, by several rewards, and measured in and out of domain.

A clone has seen demonstrations of one scene alone. IND is that scene, OOD the mean of ood_object and ood_combo.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, get_args

from benchmarks.environments.experiments import Configured
from benchmarks.environments.figures import draw_policies, extreme_table, measure_extreme
from benchmarks.environments.learned_rewards import EMBEDDING, PROXY, Learned, environment_paid_by, train_by_verdicts
from benchmarks.environments.policies import (
    SIMULATOR,
    WORLD_MODEL,
    Workplace,
    mean_gain,
    rate_of,
    rate_over_seeds,
    train_on,
)
from benchmarks.environments.reward_test import measure_rewards, rewards_table
from benchmarks.experiment import Count, console
from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import with_reader
from wm_nodes.config.scenes import draw, splits
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import part_of, parts_of
from wm_nodes.core.model_folder import files_sha256
from wm_nodes.core.progress import tqdm
from wm_nodes.core.statistics import t_interval
from wm_nodes.policy_rl.model_refresh import RefreshDecision, refresh_round, round_folder
from wm_nodes.reports.console_table import make_table
from wm_nodes.training.weights import save_weights
from wm_nodes.world_model import ImaginedEnvironment, ImaginedEpisodes
from wm_nodes.world_model.folder import read_world_manifest

TASKS = ("pick_place", "push", "pull", "move_to_aim")
MANY = "all_tasks"
"""Of each episode's task its policy is told; an episode's seed says which it is."""
Training = Literal[
    "sft", "one_scene", "all_scenes", "world_model", "refreshed", "goal", "progress", "judge", "embedding", "proxy"
]
SFT, ONE_SCENE, ALL_SCENES, MODEL, REFRESHED, GOAL, PROGRESS, JUDGE, *_ = get_args(Training)
LABELS = {
    SFT: "SFT", ONE_SCENE: "RL in the simulator, its scene", ALL_SCENES: "RL in the simulator, all training scenes",
    MODEL: "RL in the world model", REFRESHED: "the same, refreshed by the clone's episodes",
    GOAL: "the same, goal distance pays too", PROGRESS: "the same, golden progress pays too",
    JUDGE: "the same, the reward agent pays instead",
    "embedding": "the same, an embedding head pays", "proxy": "the same, a proxy network pays",
}
DENSE = {GOAL: "delta", PROGRESS: "progress"}
"""The dense reward that pays beside the done signal, a value of reward.mode."""
LEARNED: dict[str, Learned] = {"embedding": EMBEDDING, "proxy": PROXY}
IN_MODEL = {MODEL, REFRESHED, JUDGE, *DENSE, *LEARNED}
TABLE_2: tuple[Training, ...] = ("sft", "one_scene", "world_model")
TABLE_1: tuple[Training, ...] = ("sft", "one_scene", "all_scenes", "world_model", "goal")
FIGURE_4: tuple[Training, ...] = ("one_scene", "world_model", "embedding", "proxy")
FIGURE_2: tuple[Training, ...] = ("world_model", "goal", "progress", "judge", "embedding", "proxy")
OOD, TRAIN = ("ood_object", "ood_combo"), "train"
PAPER = {
    (SFT, "IND"): (12.0, 84.5, 57.7, 35.8), (SFT, "OOD"): (3.5, 13.3, 10.2, 10.6),
    (ONE_SCENE, "IND"): (85.0, 98.5, 64.2, 87.6), (ONE_SCENE, "OOD"): (32.1, 15.6, 15.5, 42.9),
    (MODEL, "IND"): (86.7, 98.7, 65.2, 88.1), (MODEL, "OOD"): (74.2, 87.3, 51.3, 72.0),
}
"""The paper's cells of its MLP policy, %, in the order of TASKS."""
PAPER |= {(GOAL, domain): PAPER[MODEL, domain] for domain in ("IND", "OOD")}


def scene_of_seed(seed: int) -> str:
    """The training scene whose demonstrations the clone of a seed has seen."""
    scenes = splits()[TRAIN]
    return scenes[draw(f"own scene {seed}", len(scenes))]


@dataclass(kw_only=True)
class RoboScape(Configured):
    """RoboScape-R at this size. Table 1: success of a policy cloned in one scene, after RL in the simulator on that
    scene, on all training scenes, and in the world model; measured in its scene (IND), with unseen objects and in
    unseen combinations (OOD). Table 2: the same of one policy for all tasks. Figure 2: the same of RL in the world
    model by several rewards. Figure 3: how well each reward tells, on imagined steps, what succeeds in the simulator.
    Figure 4: film strips of policies by what pays. Figure 9: how imagined steps obey extreme actions. What --json holds
    is not made again."""

    preset: str = "fair_start"
    """Of the settings: a name, or a .yaml."""
    table: Literal["1", "2"] | None = None
    """The trainings of Table 1, the default, or those of Table 2, of the task all_tasks."""
    figure: Literal["2", "3", "4", "9"] | None = None
    """The trainings of Figure 2 or of Figure 4, which draws their first episode; or Figure 3 or 9, which train no
    policy. Pictures are in --work."""
    tasks: tuple[str, ...] = ()
    """Columns; without, those of the table."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Each has demonstrations and a scene of its own."""
    trainings: tuple[Training, ...] = ()
    """Rows instead: the clone, and RL from it in the simulator on its scene, there on all training scenes, or in the
    model, as it is or refreshed by simulator episodes of the clone. There the done signal pays; that and the distance
    to the imagined goal or progress along the golden trajectory; or instead the reward agent's verdict, or a reward
    that was learned from success, as iVideoGPT's head or DiWA's network."""
    learned_from: Count = 200
    """Simulator episodes in training scenes that a learned reward has seen."""
    work: Path = Path("runs/roboscape")
    """Folder of episodes, first frames and policies; what is there is kept."""

    def run(self) -> None:
        if self.table and self.figure:
            raise ValueError("--table and --figure are two runs; give one of them")
        if self.figure in ("3", "9"):
            self._test_model()
        else:
            of_figure = {"2": FIGURE_2, "4": FIGURE_4}.get(self.figure or "", TABLE_1)
            self._train(self.trainings or (TABLE_2 if self.table == "2" else of_figure))

    @property
    def columns(self) -> tuple[str, ...]:
        return self.tasks or ((MANY,) if self.table == "2" else TASKS)

    def _train(self, trainings: Sequence[str]) -> None:
        shown = list[dict[str, Any]]()
        cells = [(task, seed, name) for task in self.columns for seed in self.seeds for name in trainings]
        for task, seed, training in tqdm(cells, desc="cells", unit="cell"):
            place, own = workplace(self, self.work, task, seed, training)
            wanted = {**place.identity(SIMULATOR, (own, *OOD)), "model": training, "task": task, "seed": seed}
            if training in LEARNED:
                wanted["learned_from"] = self.learned_from
            shown += self.once(wanted, partial(_cell, place, training, own, self.learned_from, self.work))
        self._show(shown, trainings)
        if self.figure == "4":
            self._draw(shown)

    def _draw(self, rows: Sequence[dict[str, Any]]) -> None:
        for task, seed in dict.fromkeys((row["task"], row["seed"]) for row in rows):
            of = [row for row in rows if (row["task"], row["seed"]) == (task, seed)]
            place, _ = workplace(self, self.work, task, seed, SFT)
            weights = {LABELS[row["model"]]: Path(row["weights"]) for row in of}
            for path in draw_policies(place, weights, (of[0]["scene"], *OOD), place.folder):
                console.print(f"film strip: {path}")

    def _test_model(self) -> None:
        shown, of_rewards = list[dict[str, Any]](), self.figure == "3"
        for task in tqdm(self.columns, desc="tasks", unit="task"):
            folder = self.model_dir or shipped_model(task)
            config = with_reader(load_config(self.preset, {**self.settings, "task": task}), folder)
            wanted: dict[str, Any] = {
                "config": config.model_dump(mode="json"),
                "world_model_sha256": files_sha256(read_world_manifest(folder)),
            }
            if of_rewards:
                wanted["learned_from"] = self.learned_from
                make = partial(measure_rewards, config, folder, self.learned_from, self.work)
            else:
                wanted["figure"] = self.figure
                make = partial(measure_extreme, config, folder, self.work)
            shown += self.once(wanted, make)
        console.print(rewards_table(shown) if of_rewards else extreme_table(shown))

    def _show(self, rows: Sequence[dict[str, Any]], trainings: Sequence[str]) -> None:
        columns = [(task, part, domain)
                   for task in self.columns for part in parts_of(task) for domain in ("IND", "OOD")]
        lines = []
        for training in trainings:
            of = {task: [row for row in rows if (row["model"], row["task"]) == (training, task)]
                  for task in self.columns}
            lines.append((LABELS[training], *(cell(of[task], domain, part) for task, part, domain in columns)))
            if any(paper := [_paper(training, task, domain) for task, _, domain in columns]):
                lines.append(("  paper", *paper))
        names = [f"{part} {domain}" for _, part, domain in columns]
        console.print(make_table("success, %; in brackets: the model is not accepted", ("", *names), lines))
        for base in (ONE_SCENE, ALL_SCENES):
            if text := gain(rows, base):
                console.print(f"OOD, {LABELS[MODEL]} less {LABELS[base]}, mean over tasks: {text} points")


def workplace(of: Configured, work: Path, task: str, seed: int, training: str) -> tuple[Workplace, str]:
    """Where one policy is made, below `work`, by the settings of an experiment; and the scene of its clone."""
    own, dense = scene_of_seed(seed), dict[str, Any]()
    if training in DENSE:
        dense = {"reward.dense_weight": 1.0, "reward.mode": DENSE[training]}
    config = load_config(of.preset, {"sft.scenes": own, **dense, **of.settings, "task": task, "seed": seed})
    return Workplace(config, of.model_dir or shipped_model(task), work.absolute() / f"{task}_{seed}"), own


def _cell(
    place: Workplace, training: str, own: str, learned_from: int, work: Path
) -> Iterator[dict[str, Any]]:
    """Train one policy and measure it in every column; one row."""
    config, policy, report, refresh = place.config, place.policy(), None, None
    imagined: ImaginedEpisodes | None = None
    if training == REFRESHED:
        place, refresh = _refreshed(place)
    if training in IN_MODEL:
        imagined = place.environment(WORLD_MODEL)
        before = place.imagined(policy, imagined)
        report = place.acceptance(WORLD_MODEL, policy, before, place.real(policy, TRAIN))
        assert isinstance(imagined, ImaginedEnvironment)
        imagined.picture_noise = config.imagined_environment.picture_noise  # while it is trained in
    if training in LEARNED:
        imagined = environment_paid_by(LEARNED[training], place, learned_from, work)
    course = list[float]()
    if training != SFT:
        words = f"{config.task}, seed {config.seed}, {LABELS[training]}"
        with tqdm(total=config.ppo.updates, desc=words, unit="update") as bar:
            updates = (
                train_by_verdicts(place, policy, imagined) if imagined and training == JUDGE
                else train_on(place, policy, imagined, own if training == ONE_SCENE else TRAIN)
            )
            for success_rate in updates:
                course.append(success_rate)
                bar.update()
    settings = sha256(config.model_dump_json().encode()).hexdigest()
    weights = place.folder / f"{training}_{settings[:8]}.safetensors"
    save_weights(policy, weights, {"tokenizer_sha256": policy.encoder.sha256})
    found = {name: place.real(policy, name) for name in (own, *OOD)}
    yield {
        "scene": own, "course": course, "weights": str(weights),
        **({} if report is None else {"accepted": report.passed, "acceptance": report.to_dict()}),
        **({} if refresh is None else {"refresh": refresh.to_dict()}),
        "success": {
            name: {**rate_of(result), "episodes_won": result.success.astype(int).tolist()}
            for name, result in found.items()
        },
    }


def _refreshed(workplace: Workplace) -> tuple[Workplace, RefreshDecision]:
    """The same with a model that went on learning from the clone's episodes in the simulator (model_refresh), and how
    it compares with the old one; it is taken in either case."""
    config, folder, (starts, weights) = workplace.config, workplace.rounds, workplace.start
    decision = refresh_round(config, workplace.model_dir, weights, starts, folder, 1)
    return replace(workplace, model_dir=round_folder(folder, 1) / "model"), decision


def success_of(row: dict[str, Any], domain: str, part: str = "") -> float:
    """Success in a domain, %. part: in those of its episodes alone that were of this one of parts_of its task."""
    names = (row["scene"],) if domain == "IND" else OOD
    if part in ("", row["task"]):
        return 100 * fmean(row["success"][name]["rate"] for name in names)
    first = row["config"]["evaluation"]["first_seed"]
    won = [won for name in names for number, won in enumerate(row["success"][name]["episodes_won"])
           if part_of(row["task"], first + number) == part]
    return 100 * fmean(won) if won else float("nan")


def cell(rows: Sequence[dict[str, Any]], domain: str, part: str = "") -> str:
    """Mean over seeds, with its t interval (inside 0 to 100) where there are several; in brackets where the model is
    not accepted."""
    if not rows:
        return ""
    text = rate_over_seeds([success_of(row, domain, part) for row in rows])
    return text if all(row.get("accepted", True) for row in rows) else f"[{text}]"


def gain(rows: Iterable[dict[str, Any]], base: str, training: str = MODEL) -> str:
    """The paper's headline by its formula, mean_gain, over the tasks and seeds that both have; "" without any."""
    rates = {(row["seed"], row["model"], row["task"]): success_of(row, "OOD") for row in rows}
    both = [(seed, task) for seed, name, task in rates if name == training and (seed, base, task) in rates]
    of_seeds = [
        mean_gain({(str(seed), name, task): rates[seed, name, task] for one, task in both if one == seed
                   for name in (training, base)}, training, base)
        for seed in sorted({seed for seed, _ in both})
    ]
    if not of_seeds:
        return ""
    text = f"{fmean(of_seeds):+.1f}"
    if len(of_seeds) > 1:
        over = t_interval(of_seeds)
        text = f"{text} ({over.low:+.1f} to {over.high:+.1f} over {len(of_seeds)} seeds)"
    return text


def _paper(training: str, task: str, domain: str) -> str:
    cells = PAPER.get((training, domain))
    return f"{cells[TASKS.index(task)]:.1f}" if cells and task in TASKS else ""
