"""Rows of the tables of docs/results/roboscape.md; what they are about stands in pages.yaml."""

from collections.abc import Sequence
from itertools import product
from statistics import fmean
from typing import get_args

from benchmarks.environments.clones import TASKS as CLONED
from benchmarks.environments.replays import of_split
from benchmarks.environments.reward_test import shown
from benchmarks.environments.roboscape import (
    ALL_SCENES,
    FIGURE_2,
    GOAL,
    JUDGE,
    LABELS,
    MANY,
    MODEL,
    ONE_SCENE,
    PAPER,
    PROGRESS,
    REFRESHED,
    SFT,
    TABLE_1,
    TASKS,
    gain,
    success_of,
)
from benchmarks.tables.table import Rows, Run, interval, read
from wm_nodes.config.scenes import splits
from wm_nodes.config.schema import PolicyInputs
from wm_nodes.config.tasks import parts_of
from wm_nodes.core.statistics import t_interval

REWARDS, RECOVERIES, BETTER = (f"roboscape_{name}.json" for name in ("rewards", "recoveries", "better_clones"))
TRAINED = tuple(f"roboscape_{name}.json" for name in ("table1", "more", "tasks", "state"))
PPO, CLONES, EXTREME, SEVERAL, UNAIDED = (
    f"roboscape_{name}.json" for name in ("ppo", "clones", "extreme_actions", "table2", "no_positions")
)
AFTER = 1, 8, 32
"""Steps of a rollout at which its pictures are compared."""
DOMAINS = "IND", "OOD"
POSITIONS = "positions"
SEEN = POSITIONS, "latents", "state"
"""Values of policy.inputs."""
OURS = "reach_object"
"""A task that the paper does not have."""
PAYS = {
    MODEL: "done signal", REFRESHED: "done signal, refreshed",
    GOAL: "goal distance and done signal", PROGRESS: "golden progress and done signal",
    JUDGE: "verdict of the reward agent", "embedding": "embedding head (iVideoGPT)", "proxy": "proxy network (DiWA)",
}


def trained(training: str, task: str, inputs: str = POSITIONS) -> list[Run]:
    """Rows of Table 1, by seed; of a seed the first. inputs: policy.inputs."""
    wanted, found = (training, task, inputs), dict[int, Run]()
    for row in (row for file in TRAINED for row in read(file)["rows"]):
        if (row["model"], row["task"], row["config"]["policy"]["inputs"]) == wanted:
            found.setdefault(int(row["seed"]), row)
    return [found[seed] for seed in sorted(found)]


def table_1() -> Rows:
    for task, inputs, training in product((*TASKS, OURS), SEEN, (*TABLE_1, REFRESHED)):
        if of := trained(training, task, inputs):
            papers = (PAPER.get((training, domain)) if task in TASKS else None for domain in DOMAINS)
            yield (
                task, f"{inputs}, {_shown_to(of[0])}", LABELS[training],
                *(f"{fmean(success_of(row, domain) for row in of):.1f}" for domain in DOMAINS),
                *(", ".join(f"{success_of(row, domain):.1f}" for row in of) for domain in DOMAINS),
                ", ".join(row["acceptance"]["outcome"] for row in of) if "acceptance" in of[0] else "",
                *("" if paper is None else paper[TASKS.index(task)] for paper in papers),
            )


def _shown_to(row: Run) -> str:
    """The demonstrations of a row's clone, and recoveries."""
    sft = row["config"]["sft"]
    more = sft.get("recoveries", 0)
    return f"{sft['num_demonstrations']}{f' and {more} recoveries' if more else ''}"


def table_1_gains() -> Rows:
    for training, inputs, base, task in product(
        (MODEL, GOAL, PROGRESS, REFRESHED), SEEN, (SFT, ONE_SCENE, ALL_SCENES), (*TASKS, OURS)
    ):
        if text := gain([*trained(training, task, inputs), *trained(base, task, inputs)], base, training):
            yield task, inputs, PAYS[training], LABELS[base], text


def better_clones() -> Rows:
    for row in read(BETTER)["rows"]:
        accepted = row["acceptance"]["outcome"] if "acceptance" in row else ""
        yield (row["task"], row["seed"], _shown_to(row), LABELS[row["model"]],
               *(f"{success_of(row, domain):.1f}" for domain in DOMAINS), accepted)


def figure_2() -> Rows:
    base = {row["seed"]: success_of(row, "OOD") for row in trained(MODEL, "push")}
    for training in FIGURE_2:
        if of := trained(training, "push"):
            differences = [success_of(row, "OOD") - base[row["seed"]] for row in of]
            apart = "" if training == MODEL else f"{fmean(differences):+.1f}"
            if apart and len(of) > 1:
                over = t_interval(differences)
                apart = interval(over.mean, over.low, over.high, 1)
            yield PAYS[training], *(by_seed([success_of(row, domain) for row in of]) for domain in DOMAINS), apart


def by_seed(rates: Sequence[float]) -> str:
    text = f"{fmean(rates):.1f}"
    return text if len(rates) == 1 else f"{text} ({', '.join(f'{rate:.0f}' for rate in rates)})"


def rewards() -> Rows:
    found = read(REWARDS)["rows"]
    for task, reward in dict.fromkeys((one["task"], one["reward"]) for one in found):
        of = {one["domain"]: one for one in found if (one["task"], one["reward"]) == (task, reward)}
        yield (
            task, reward, *("{:.2f} [{:.2f}, {:.2f}]".format(*of[domain]["auroc"]) for domain in splits()),
            *("/".join(shown(of[domain][name], form) for domain in splits())
              for name, form in (("auroc_empty_hand", ".2f"), ("rank_correlation", "+.2f"))),
        )


def replays() -> Rows:
    for row in read("roboscape_replays.json")["rows"]:
        places = "simulator's" if row["config"]["simulation"]["object_state"] == "truth" else "read off pictures"
        yield row["task"], row["seed"], LABELS[row["model"]], places, *map(of_split, row["replays"].values())


def ppo_settings() -> Rows:
    """The preset's row first; of the others what differs from it."""
    runs = [row for row in read(PPO)["rows"] if row["model"] == MODEL]
    base = runs[0]["config"]
    for row in runs:
        changed = [f"{part}.{name} {value}" for part, values in row["config"].items()
                   for name, value in values.items() if value != base[part][name]]
        yield (
            row["seed"], ", ".join(changed) or "preset", *(f"{success_of(row, domain):.1f}" for domain in DOMAINS),
            f"{100 * row['course'][-1]:.1f}",
        )


def clones() -> Rows:
    """States are of the shipped model alone."""
    found = read(CLONES)["rows"]
    shipped = next(row["models_sha256"] for row in found if row["config"]["policy"]["inputs"] == "state")
    for task, seen, former in product(CLONED, get_args(PolicyInputs), (False, True)):
        of = [row for row in found if (row["task"], row["config"]["policy"]["inputs"]) == (task, seen)
              and (row["models_sha256"] != shipped) == former]
        for count in sorted({row["config"]["sft"]["num_demonstrations"] for row in of}):
            its = [row for row in of if row["config"]["sft"]["num_demonstrations"] == count]
            late, early = ([row for row in its if bool(row["config"]["sft"]["heldout"]) == held]
                           for held in (False, True))
            yield (
                task, f"{seen}, former model" if former else seen, count,
                ", ".join(str(row["seed"]) for row in late),
                *(by_seed([100 * row["success"][split]["rate"] for row in rows]) if rows else ""
                  for rows in (late, early) for split in splits()),
            )


def recoveries() -> Rows:
    """Beside the clones of Table 1 those of as many demonstrations more, or recoveries."""
    tasks, groups = (*TASKS, OURS), dict[tuple[str, int, int, str], list[Run]]()
    for row in (*(row for task in tasks for row in trained(SFT, task)), *read(RECOVERIES)["rows"]):
        sft, gripper = row["config"]["sft"], "-1 or 1" if row["config"]["policy"].get("two_valued_actions") else ""
        groups.setdefault(
            (row["task"], sft["num_demonstrations"], sft.get("recoveries", 0), gripper), []
        ).append(row)
    for task, count, more, gripper in sorted(groups, key=lambda one: (tasks.index(one[0]), one[1] + one[2], one)):
        of = groups[task, count, more, gripper]
        yield (
            task, count, more or "", gripper, ", ".join(str(row["seed"]) for row in of),
            *(by_seed([success_of(row, domain) for row in of]) for domain in DOMAINS),
        )


def extreme() -> Rows:
    for row in read(EXTREME)["rows"]:
        drops = (row["metrics"][f"psnr_shuffled_drop_db_h{step:02d}"] for step in AFTER)
        yield row["task"], row["domain"], row["actions"], row["episodes"], *(f"{drop:+.2f}" for drop in drops)


def no_positions() -> Rows:
    for row in read(UNAIDED)["rows"]:
        imagined = [100 * row["course"][place] for place in (0, -1)] if row["course"] else []
        report = row.get("acceptance", {})
        why = ", ".join(report.get("failed") or report.get("undecided", []))
        yield (
            LABELS[row["model"]], *(f"{success_of(row, domain):.1f}" for domain in DOMAINS),
            " → ".join(f"{rate:.1f}" for rate in imagined),
            f"{report['outcome']}: {why}" if report else "",
        )


def table_2() -> Rows:
    of = {row["model"]: row for row in read(SEVERAL)["rows"]}
    for part in parts_of(MANY):
        for training, row in of.items():
            rates = [success_of(row, domain, part) for domain in DOMAINS]
            less = [rate - success_of(of[SFT], domain, part) for rate, domain in zip(rates, DOMAINS, strict=True)]
            yield (
                part, LABELS[training], *(f"{rate:.1f}" for rate in rates),
                *("" if training == SFT else f"{difference:+.1f}" for difference in less),
            )


def openvla_size() -> Rows:
    found = read("openvla_size.json")["rows"][0]
    yield (
        f"{found['parameters'] / 1e9:.2f}", f"{found['trained'] / 1e6:.0f}",
        *(f"{found[name]:.3g}" for name in (
            "weights_gib", "gradients_and_adam_gib", "kept_for_backward_gib_per_picture", "forward_tflop_per_picture",
            "backward_tflop_per_picture",
        )),
    )
