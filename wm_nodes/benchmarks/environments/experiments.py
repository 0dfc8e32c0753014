"""Models as the environment of a policy: what a policy that is trained in each is worth in the simulator, and how each
ranks policies.
"""

import argparse
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.environments.policies import (
    SIMULATOR,
    SIMULATOR_ENVS,
    WORLD_MODEL,
    Workplace,
    known_policy,
    measure_policy,
    rank_policies,
    train_in,
)
from benchmarks.experiment import Experiment, console, rounded
from wm_nodes.apps import options
from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import with_reader
from wm_nodes.config.scenes import check_scenes
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import compute_device
from wm_nodes.core.files import file_sha256
from wm_nodes.core.progress import tqdm
from wm_nodes.core.statistics import bootstrap_mean, paired_difference
from wm_nodes.environments.registry import make_environment
from wm_nodes.policy_rl.factories import load_policy, make_policy
from wm_nodes.policy_rl.validation.evaluation import evaluate
from wm_nodes.reports.console_table import make_table


@dataclass(kw_only=True)
class Configured(Experiment):
    """An experiment that takes the policy settings as options."""

    preset: str = "cpu"
    """Of the settings: a name, or a .yaml."""
    model_dir: Path | None = None
    """World model instead of the shipped one."""

    def once(self, wanted: Mapping[str, Any], make: Callable[[], Iterable[Mapping[str, Any]]]) -> list[dict[str, Any]]:
        """The rows that --json holds of these values, else those made now; processes may share the file."""
        if found := [row for row in self.read() if is_finished([row], wanted)]:
            return found
        made = [{**wanted, **row} for row in make()]
        self.write({"rows": [*self.read(), *made]}, device=wanted["config"]["device"])
        return made

    @classmethod
    def add_settings(cls, parser: argparse.ArgumentParser) -> None:
        options.add_settings(parser)
        options.add_device(parser)

    @classmethod
    def settings_of(cls, arguments: argparse.Namespace) -> dict[str, Any]:
        return options.settings(arguments)


@dataclass(kw_only=True)
class InModels(Configured):
    """An experiment on models as the environment of a policy; the task's world model is always the first of them."""

    video_models: tuple[Path, ...] = ()
    """Folders of video models that can be stepped."""
    work: Path = Path("runs/environments")
    """Folder of first frames and policies; what is there is kept."""

    @property
    def models(self) -> list[str]:
        return [WORLD_MODEL, *map(str, self.video_models)]

    def workplace(self, task: str, seed: int) -> Workplace:
        config = load_config(self.preset, {"task": task, **self.settings, "seed": seed})
        compute_device(config.device)
        model_dir = self.model_dir or shipped_model(config.task)
        return Workplace(config, model_dir, self.work.absolute() / f"{config.task}_{seed}")


@dataclass(kw_only=True)
class TrainedIn(InModels):
    """Train a policy in each model, measure it in the simulator. The task's world model is always the first of them;
    in it, by model_refresh and exploit_meter, too."""

    tasks: tuple[str, ...] = ("push_cube",)
    """Of the policies."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """A training in each model for each."""
    control: bool = False
    """Train in the simulator, too, with as many steps."""
    scenes: tuple[str, ...] = ()
    """Measure the policies there, too: splits or scenes, as simulation.scenes."""

    def run(self) -> None:
        rows, scenes = self.read(), tuple(map(check_scenes, self.scenes))
        places = [self.workplace(task, seed) for task in self.tasks for seed in self.seeds]
        for workplace, model in product(places, [*self.models, *([SIMULATOR] if self.control else [])]):
            config = workplace.config
            if is_finished(rows, workplace.identity(model, scenes)):
                continue
            words = f"{Path(model).name}, {config.task}, seed {config.seed}"
            with tqdm(total=config.ppo.updates, desc=words, unit="update") as bar:
                rows.append(train_in(workplace, model, scenes, bar.update))
            self.write({"rows": rows})
            if report := rows[-1]["acceptance"]:
                why = f" ({', '.join(names)})" if (names := report["failed"] or report["undecided"]) else ""
                console.print(f"{words}: acceptance {report['outcome']}{why}")
        columns = (
            "trained in", "task", "seed", "scenes", "real before", "real after", "gain", "imagined", "acceptance"
        )
        lines = [line for row in rows for line in _lines(row)] + _over_seeds(rows)
        console.print(make_table("policies trained in each model", columns, lines))


@dataclass(kw_only=True)
class Ranking(InModels):
    """Imagined success of policies in each model against their real success. The task's world model is always the first
    of the models."""

    task: str = "push_cube"
    """Of the policies."""
    policies: tuple[Path, ...]
    """Weights, 8 or more files."""
    seed: int = 0
    """Of the starts and of the bootstrap."""

    def run(self) -> None:
        rows, workplace, models = self.read(), self.workplace(self.task, self.seed), self.models
        ranked = list[dict[str, Any]]()
        for path in tqdm(self.policies, desc="policies", unit="policy"):
            wanted = known_policy(workplace, path, models)
            if not (found := [row for row in rows if is_finished([row], wanted)]):
                found = [measure_policy(workplace, path, models)]
                rows += found
                self.write({"rows": rows})
            ranked += found[:1]
        correlations = rank_policies(ranked, models, self.seed)
        self.write({"rows": rows, "correlations": correlations})
        console.print(make_table(
            f"imagined against real success of {len(ranked)} policies", ("model", "rank correlation", "95 %"),
            [(model, f"{one['correlation']:+.2f}", f"{one['low']:+.2f} to {one['high']:+.2f}")
             for model, one in correlations.items()],
        ))


@dataclass(kw_only=True)
class Measured(Configured):
    """Measure a policy in evaluation.environment: success, and of each of gymnasium.measures the largest in an episode.
    """

    task: str = ""
    """Of the environment; empty for one of your own."""
    model_dir: Path | None = None
    """World model whose tokenizer the policy sees by; without, policy.factory makes it."""
    weights: Path | None = None
    """The policy's; without, as it is made."""

    def run(self) -> None:
        config, rows = load_config(self.preset, {"task": self.task, **self.settings}), self.read()
        policy = str(self.weights or config.policy.factory or "untrained")
        wanted: dict[str, Any] = {"policy": policy, "config": config.model_dump(mode="json")}
        if self.weights:
            wanted["sha256"] = file_sha256(self.weights)
        if not is_finished(rows, wanted):
            rows.append({**wanted, **self._measured(config)})
            self.write({"rows": rows}, device=config.device)
        columns = ("policy", "successes", "95 %", *(f"{name}, largest" for name in config.gymnasium.measures))
        console.print(make_table(f"{config.gymnasium.env_id}: a policy in {config.evaluation.environment}", columns, [
            (row["policy"], f"{row['successes']} of {row['episodes']}", f"{row['low']:.3f} to {row['high']:.3f}",
             *("{:.3f} ({:.3f} to {:.3f})".format(*row["measures"][name]) for name in config.gymnasium.measures))
            for row in rows
            if all(row["config"][part] == wanted["config"][part] for part in ("gymnasium", "evaluation"))
        ]))

    def _measured(self, config: RunConfig) -> dict[str, Any]:
        how, model = config.evaluation, self.model_dir
        config = with_reader(config, model)
        policy = load_policy(config, model, self.weights) if self.weights else make_policy(config, model)
        with (
            closing(make_environment(config, how.environment, num_envs=SIMULATOR_ENVS, seed=config.seed)) as env,
            tqdm(total=how.episodes, desc="episodes", unit="episode") as bar,
        ):
            def show(done: int, _: int) -> None:
                bar.update(done - bar.n)

            found = evaluate(policy, env, how.episodes, how.first_seed, how.deterministic, on_progress=show)
        return {
            "successes": found.successes, "episodes": found.episodes, "low": found.low, "high": found.high,
            "mean_length": found.mean_length, "measures": {
                name: bootstrap_mean(values, seed=config.seed)
                for name, values in zip(env.spec.ground_truth_names, found.largest.T)
                if name in config.gymnasium.measures
            },
        }


def is_finished(rows: Sequence[Mapping[str, Any]], wanted: Mapping[str, Any]) -> bool:
    """Whether one of the rows has all of the wanted values, up to the digits that a file holds."""
    asked = rounded(wanted)
    return any(rounded({name: row.get(name) for name in asked}) == asked for row in rows)


def _outcome(row: dict[str, Any]) -> str:
    """What acceptance says of the model of a row; nothing of the simulator, nor of rows of earlier versions."""
    return str(row.get("acceptance", {}).get("outcome", ""))


def _lines(row: dict[str, Any]) -> list[tuple[str, ...]]:
    """A line of the table for the scenes of the training, and one for each of the others."""
    first = {"before": row["real_before"], "after": row["real_after"], "gain": row["real_gain"]}
    imagined = f"{_percent(row['imagined_before'])} -> {_percent(row['imagined_after'])}"
    return [
        (row["model"], row["task"], str(row["seed"]), name, _percent(found["before"]), _percent(found["after"]),
         "{difference:+.3f} ({low:+.3f} to {high:+.3f})".format(**found["gain"]),
         *(("", "") if name else (imagined, _outcome(row))))
        for name, found in {"": first, **row.get("elsewhere", {})}.items()
    ]


def _over_seeds(rows: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """A line for each model and task of the same settings with several seeds: the difference over all episodes. Rows
    that were measured in other scenes, too, are others: of one seed they hold the same episodes."""
    groups = dict[str, list[dict[str, Any]]]()
    for row in rows:
        same = [row.get(name) for name in ("model", "models_sha256", "scenes")], {**row["config"], "seed": ""}
        groups.setdefault(json.dumps(same), []).append(row)
    lines = list[tuple[str, ...]]()
    for of in groups.values():
        if len(of) > 1:
            before, after = (
                [bool(won) for row in of for won in row[f"success_{when}"]] for when in ("before", "after")
            )
            pair, seeds = paired_difference(before, after), ", ".join(str(row["seed"]) for row in of)
            lines.append((
                of[0]["model"], of[0]["task"], seeds, "",
                *(_percent({"rate": fmean(won), "episodes": len(won)}) for won in (before, after)),
                f"{pair.difference:+.3f} ({pair.low:+.3f} to {pair.high:+.3f})", "", "",
            ))
    return lines


def _percent(rate: dict[str, float]) -> str:
    return f"{100 * rate['rate']:.1f} % of {rate['episodes']:.0f}"
