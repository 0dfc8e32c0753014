"""How many of a policy's successes in the world model are successes in the simulator, in scenes of every split."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.environments.experiments import Configured
from benchmarks.environments.policies import WORLD_MODEL, Workplace
from benchmarks.environments.roboscape import LABELS, SFT, Training, workplace
from benchmarks.experiment import console
from wm_nodes.config.scenes import splits
from wm_nodes.config.seed_ranges import NEW_CONTEXTS
from wm_nodes.core.progress import tqdm
from wm_nodes.core.statistics import wilson_of_share
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.validation.acceptance import in_scenes, roll_out
from wm_nodes.reports.console_table import make_table


@dataclass(kw_only=True)
class Replays(Configured):
    """How many of a policy's successes in the world model are real: it plays evaluation.episodes first frames of the
    training scenes, of unseen objects and of unseen combinations there, and the simulator replays its actions; also
    where the robot then holds still for three steps."""

    preset: str = "fair_start"
    """Of the settings: a name, or a .yaml."""
    tasks: tuple[str, ...] = ("push",)
    """Of the policies."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the policies."""
    trainings: tuple[Training, ...] = ("sft", "world_model")
    """The policies: the clone, which is made where it is missing, and those that wm reproduce roboscape has trained."""
    work: Path = Path("runs/roboscape")
    """Folder of wm reproduce roboscape."""

    def run(self) -> None:
        shown = list[dict[str, Any]]()
        cells = [(task, seed, name) for task in self.tasks for seed in self.seeds for name in self.trainings]
        for task, seed, training in tqdm(cells, desc="policies", unit="policy"):
            place, _ = workplace(self, self.work, task, seed, training)
            wanted = {**place.identity(WORLD_MODEL, tuple(splits())), "model": training, "task": task, "seed": seed}
            shown += self.once(wanted, partial(_row, place, training))
        console.print(make_table(
            "imagined successes that are real, by split", ("task", "seed", "policy", *splits()),
            [(row["task"], str(row["seed"]), LABELS[row["model"]], *map(of_split, row["replays"].values()))
             for row in shown],
        ))


def of_split(found: dict[str, list[int]]) -> str:
    """Real and imagined successes among the starts, the share of the imagined ones that are real, and how many are real
    where the robot then holds still."""
    real, late = ([again for again, seen in zip(found[name], found["imagined"], strict=True) if seen]
                  for name in ("replayed", "held"))
    share, low, high = wilson_of_share(real)
    text = f"{sum(real)} of {len(real)}: {100 * share:.0f} % [{100 * low:.0f}, {100 * high:.0f}], held {sum(late)}"
    return text if real else "none"


def _row(place: Workplace, training: str) -> Iterator[dict[str, Any]]:
    """Play one policy in every split."""
    policy = place.policy(None if training == SFT else _weights(place.folder, training))
    yield {"replays": {scenes: _replayed(place, policy, scenes) for scenes in splits()}}


def _weights(folder: Path, training: str) -> Path:
    found = [*folder.glob(f"{training}_????????.safetensors")]
    if len(found) != 1:
        raise ValueError(f"{folder} holds {len(found) or 'no'} policies of the training {training!r}, one is needed; "
                         f"wm reproduce roboscape --trainings {training} --work {folder.parent} trains it")
    return found[0]


def _replayed(place: Workplace, policy: ImagePolicy, scenes: str) -> dict[str, list[int]]:
    count, folder = place.config.evaluation.episodes, place.folder / "replays" / scenes
    found = roll_out(*in_scenes(place.config, scenes, count, NEW_CONTEXTS, folder), place.model_dir, policy)
    return {name: getattr(found, name).astype(int).tolist() for name in ("imagined", "replayed", "held")}
