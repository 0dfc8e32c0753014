"""Models as the environment of a policy: what a policy that is trained in each is worth in the simulator, how each
ranks policies, and how fast it steps. The task's world model is always the first of them.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.environments.policies import (
    SIMULATOR,
    WORLD_MODEL,
    Workplace,
    measure_policy,
    measure_speed,
    rank_policies,
    train_in,
)
from benchmarks.speed.results import write_results
from wm_nodes.apps.options import add_json, add_preset, positive, prepare_torch, settings
from wm_nodes.config.load import load_config
from wm_nodes.config.scenes import check_scenes
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import compute_device
from wm_nodes.core.progress import tqdm
from wm_nodes.reports.console_table import make_table

console = Console()


def add_options(parser: argparse.ArgumentParser) -> None:
    experiments = parser.add_subparsers(dest="experiment", required=True, metavar="EXPERIMENT")
    trained = experiments.add_parser("trained-in", help="train a policy in each model, measure it in the simulator")
    ranking = experiments.add_parser("ranking", help="imagined success of policies against their real success")
    speed = experiments.add_parser("speed", help="environment steps/s")
    ranking.add_argument("--policies", type=Path, nargs="+", required=True, metavar="FILE", help="weights, 8 or more")
    speed.add_argument("--steps", type=positive, default=16, help="lock-steps of the rollout (default: 16)")
    for experiment in (trained, ranking, speed):
        experiment.add_argument("--video-models", type=Path, nargs="*", default=[], metavar="DIR",
                                help="folders of video models that can be stepped")
        add_preset(experiment, "cpu")
        experiment.add_argument("--task", default="push_cube")
        experiment.add_argument("--model-dir", type=Path, metavar="DIR", help="world model instead of the shipped one")
        experiment.add_argument("--work", type=Path, default=Path("runs/environments"), metavar="DIR",
                                help="folder of first frames and policies; what is there is kept")
        add_json(experiment, "write every row here; what it holds is not measured again")
    trained.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    trained.add_argument("--control", action="store_true", help="train in the simulator, too, with as many steps")
    trained.add_argument("--scenes", nargs="+", default=[], metavar="SCENES", type=check_scenes,
                         help="measure the policies there, too: splits or scenes, as simulation.scenes")
    for experiment in (ranking, speed):
        experiment.add_argument("--seed", type=int, default=0)


def run(arguments: argparse.Namespace) -> None:
    prepare_torch()
    models = [WORLD_MODEL, *(str(folder) for folder in arguments.video_models)]
    {"trained-in": _trained_in, "ranking": _ranking, "speed": _speed}[arguments.experiment](arguments, models)


def _workplace(arguments: argparse.Namespace, seed: int) -> Workplace:
    config = load_config(arguments.preset, {"task": arguments.task, **settings(arguments), "seed": seed})
    compute_device(config.device)
    model_dir = arguments.model_dir or shipped_model(config.task)
    return Workplace(config, model_dir, arguments.work.absolute() / f"{config.task}_{seed}")


def _trained_in(arguments: argparse.Namespace, models: list[str]) -> None:
    rows = _kept_rows(arguments)
    for seed in arguments.seeds:
        workplace = _workplace(arguments, seed)
        updates = workplace.config.ppo.updates
        for model in [*models, *([SIMULATOR] if arguments.control else [])]:
            wanted = workplace.identity(model, arguments.scenes)
            if is_finished(rows, wanted):
                continue
            with tqdm(total=updates, desc=f"{Path(model).name}, seed {seed}", unit="update") as bar:
                rows.append(train_in(workplace, model, arguments.scenes, bar.update))
            write_results(arguments, {"rows": rows})
            if found := rows[-1]["acceptance"]:
                why = ", ".join(found["failed"] or found["undecided"])
                console.print(f"{Path(model).name}, seed {seed}: acceptance {found['outcome']} ({why})")
    columns = ("trained in", "task", "seed", "scenes", "real before", "real after", "gain", "imagined", "acceptance")
    names = differing(rows)
    console.print(make_table(
        "policies trained in each model", (*columns, *(["settings"] if names else [])),
        [(*line, *([_of_settings(row, names)] if names else [])) for row in rows for line in _lines(row)],
    ))
    if names:
        console.print(f"settings: {', '.join(names)}", soft_wrap=True)


def is_finished(rows: Sequence[Mapping[str, Any]], wanted: Mapping[str, Any]) -> bool:
    """Whether one of the rows has all of the wanted values."""
    return any(all(row.get(name) == value for name, value in wanted.items()) for row in rows)


def differing(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The dotted settings, but task and seed, that are not the same in all rows that hold theirs."""
    found = [_dotted(row["config"]) for row in rows if "config" in row]
    names = dict.fromkeys(name for settings in found for name in settings)
    return [name for name in names if len({repr(one.get(name)) for one in found}) > 1 and name not in ("task", "seed")]


def _dotted(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = dict[str, Any]()
    for name, value in values.items():
        flat |= _dotted(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _of_settings(row: dict[str, Any], names: Sequence[str]) -> str:
    settings = _dotted(row.get("config", {}))
    return ", ".join(str(settings.get(name, "?")) for name in names)


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


def _ranking(arguments: argparse.Namespace, models: list[str]) -> None:
    rows, workplace = _kept_rows(arguments), _workplace(arguments, arguments.seed)
    for path in tqdm(arguments.policies, desc="policies", unit="policy"):
        wanted = {"policy": str(path), "config": workplace.config.model_dump(mode="json")}
        if not is_finished([row for row in rows if set(models) <= row["imagined"].keys()], wanted):
            rows.append(measure_policy(workplace, path, models))
            write_results(arguments, {"rows": rows})
    correlations = rank_policies(rows, models, arguments.seed)
    write_results(arguments, {"rows": rows, "correlations": correlations})
    console.print(make_table(
        f"imagined against real success of {len(rows)} policies", ("model", "rank correlation", "95 %"),
        [(model, f"{found['correlation']:+.2f}", f"{found['low']:+.2f} to {found['high']:+.2f}")
         for model, found in correlations.items()],
    ))


def _speed(arguments: argparse.Namespace, models: list[str]) -> None:
    rows = measure_speed(_workplace(arguments, arguments.seed), models, arguments.steps)
    write_results(arguments, {"rows": rows})
    console.print(make_table(
        "environment steps", ("model", "environments", "steps/s", "steps per second of CPU", "of the world model's"),
        [(row["model"], str(row["envs"]), f"{row['steps_per_s']:.0f}", f"{row['steps_per_cpu_s']:.0f}",
          f"{row['of_world_model']:.3f}") for row in rows],
    ))


def _kept_rows(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    if arguments.json is None or not arguments.json.is_file():
        return []
    rows: list[dict[str, Any]] = json.loads(arguments.json.read_text(encoding="utf-8"))["rows"]
    return rows


def _percent(rate: dict[str, float]) -> str:
    return f"{100 * rate['rate']:.1f} % of {rate['episodes']:.0f}"
