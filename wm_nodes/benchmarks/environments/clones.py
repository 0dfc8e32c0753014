"""Cloned policies without any RL, by what they see and by how many demonstrations they have seen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.environments.experiments import Configured
from benchmarks.environments.policies import SIMULATOR, Workplace, rate_of, rate_over_seeds
from benchmarks.experiment import Count, console
from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import of_demonstrations
from wm_nodes.config.scenes import splits
from wm_nodes.config.schema import PolicyInputs
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.progress import tqdm
from wm_nodes.environments.record import collect_plan, demonstration_plan
from wm_nodes.policy_rl.initial_policy import train_weak_policy
from wm_nodes.reports.console_table import make_table

TASKS = ("push", "pull", "pick_place", "move_to_aim", "reach_object")
CLONE = "clone"


@dataclass(kw_only=True)
class Clones(Configured):
    """Success of a cloned policy, without RL, by what it sees and by how many demonstrations of all training scenes it
    has seen; measured in these scenes, with unseen objects and in unseen combinations."""

    preset: str = "fair_start"
    """Of the settings: a name, or a .yaml."""
    tasks: tuple[str, ...] = TASKS
    """Each has demonstrations of its own."""
    inputs: tuple[PolicyInputs, ...] = ("latents", "positions", "both")
    """What the policy sees, values of policy.inputs; state: of a model with an object reader."""
    demonstrations: tuple[Count, ...] = (10, 25, 100, 400)
    """Numbers of them; a smaller number has the first of the largest."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Each has demonstrations of its own."""
    work: Path = Path("runs/clones")
    """Folder of demonstrations and policies; what is there is kept."""

    def run(self) -> None:
        shown = list[dict[str, Any]]()
        cells = [
            (task, seed, count, inputs)
            for seed in self.seeds for task in self.tasks for count in self.demonstrations for inputs in self.inputs
        ]
        for task, seed, count, inputs in tqdm(cells, desc="clones", unit="clone"):
            config = load_config(self.preset, {
                "simulation.scenes": "train", **self.settings, "task": task, "seed": seed, "policy.inputs": inputs,
                "sft.num_demonstrations": count,
            })
            folder = self.work.absolute() / f"{task}_{seed}"
            place = Workplace(config, self.model_dir or shipped_model(task), folder)
            wanted = {**place.identity(SIMULATOR, tuple(splits())), "model": CLONE, "task": task, "seed": seed}
            shown += self.once(wanted, partial(self._row, place))
        console.print(clones_table(shown))

    def _row(self, place: Workplace) -> Iterator[dict[str, Any]]:
        """Plan demonstrations where they are missing, clone them and measure the policy."""
        config, most = place.config, max(self.demonstrations)
        recorded = of_demonstrations(config.with_values(sft=config.sft.with_values(num_demonstrations=most)))
        plan = demonstration_plan(recorded, most + max(3, most // 3))
        bags = collect_plan(plan, recorded, place.folder / "demos")
        weights = place.folder / f"{config.policy.inputs}_{config.sft.num_demonstrations}.safetensors"
        policy = train_weak_policy(config, place.model_dir, bags, weights)
        yield {"success": {name: rate_of(place.real(policy, name)) for name in splits()}}


def clones_table(rows: Sequence[dict[str, Any]]) -> Any:
    """Means over seeds, %, with their t interval where there are several."""
    names = [(row["task"], row["config"]["sft"]["num_demonstrations"], row["config"]["policy"]["inputs"])
             for row in rows]
    lines = []
    for name in dict.fromkeys(names):
        of = [row for row, its in zip(rows, names, strict=True) if its == name]
        rates = {split: [100 * row["success"][split]["rate"] for row in of] for split in splits()}
        lines.append((*map(str, name), str(len(of)), *(rate_over_seeds(found) for found in rates.values())))
    return make_table("success of clones, %", ("task", "demonstrations", "sees", "seeds", *splits()), lines)
