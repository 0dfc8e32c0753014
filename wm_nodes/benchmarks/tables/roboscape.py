"""Rows of the tables of docs/results/roboscape.md; what they are about stands in pages.yaml."""

from collections.abc import Sequence
from itertools import product
from statistics import fmean

from benchmarks.environments.roboscape import (
    ALL_SCENES,
    LABELS,
    MODEL,
    ONE_SCENE,
    PAPER,
    SFT,
    TASKS,
    gain,
    success_of,
)
from benchmarks.tables.table import Rows, Run, interval, read
from benchmarks.video_rl.comparison import paired_interval
from wm_nodes.config.scenes import splits

REWARDS, TABLE_1 = "roboscape_rewards.json", "roboscape_table1.json"
DOMAINS = "IND", "OOD"
POSITIONS = "positions"


def trained(
    rows: Sequence[Run], training: str, task: str, inputs: str = POSITIONS, dense: float = 0.0, mode: str = "delta"
) -> list[Run]:
    """Those of the rows of Table 1, by seed. inputs: policy.inputs; dense, mode: of the reward."""
    found = [
        row for row in rows
        if (row["model"], row["task"], row["config"]["policy"]["inputs"]) == (training, task, inputs)
        and (row["config"]["reward"]["dense_weight"], row["config"]["reward"].get("mode", "delta")) == (dense, mode)
    ]
    return sorted(found, key=lambda row: int(row["seed"]))


def table_1() -> Rows:
    found = read(TABLE_1)["rows"]
    for task, inputs in product(TASKS, (POSITIONS, "latents")):
        for training, dense in ((SFT, 0), (ONE_SCENE, 0), (ALL_SCENES, 0), (MODEL, 0), (MODEL, 1)):
            of = trained(found, training, task, inputs, dense)
            if of:
                papers = (PAPER.get((training, domain)) for domain in DOMAINS)
                yield (
                    task, f"{inputs}, {of[0]['config']['sft']['num_demonstrations']}",
                    LABELS[training] + ", done signal and goal" * dense,
                    *(f"{fmean(success_of(row, domain) for row in of):.1f}" for domain in DOMAINS),
                    *(", ".join(f"{success_of(row, domain):.1f}" for row in of) for domain in DOMAINS),
                    ", ".join("yes" if row["accepted"] else "no" for row in of) if training == MODEL else "",
                    *("" if paper is None else paper[TASKS.index(task)] for paper in papers),
                )


def table_1_gains() -> Rows:
    found = read(TABLE_1)["rows"]
    for dense, inputs, base, task in product((0, 1), (POSITIONS, "latents"), (SFT, ONE_SCENE, ALL_SCENES), TASKS):
        if text := gain([*trained(found, MODEL, task, inputs, dense), *trained(found, base, task, inputs)], base):
            yield task, inputs, "done signal and goal" if dense else "done signal", LABELS[base], text


def figure_2() -> Rows:
    found = read(TABLE_1)["rows"]
    done = trained(found, MODEL, "push")
    base = {row["seed"]: success_of(row, "OOD") for row in done}
    arms = {
        "done signal": done, "goal distance and done signal": trained(found, MODEL, "push", dense=1.0),
        "embedding head (iVideoGPT)": trained(found, "embedding", "push"),
        "proxy network (DiWA)": trained(found, "proxy", "push"),
    }
    for name, of in arms.items():
        if of:
            differences = [success_of(row, "OOD") - base[row["seed"]] for row in of]
            apart = "" if name == "done signal" else f"{fmean(differences):+.1f}"
            if apart and len(of) > 1:
                over = paired_interval(differences)
                apart = interval(over.mean, over.low, over.high, 1)
            yield name, *(by_seed([success_of(row, domain) for row in of]) for domain in DOMAINS), apart


def by_seed(rates: Sequence[float]) -> str:
    text = f"{fmean(rates):.1f}"
    return text if len(rates) == 1 else f"{text} ({', '.join(f'{rate:.0f}' for rate in rates)})"


def rewards() -> Rows:
    found = read(REWARDS)["rows"]
    for task, reward in dict.fromkeys((one["task"], one["reward"]) for one in found):
        of = {one["domain"]: one for one in found if (one["task"], one["reward"]) == (task, reward)}
        yield (
            task, reward, *("{:.2f} [{:.2f}, {:.2f}]".format(*of[domain]["auroc"]) for domain in splits()),
            *("/".join(form.format(of[domain][name]) for domain in splits())
              for name, form in (("auroc_empty_hand", "{:.2f}"), ("rank_correlation", "{:+.2f}"))),
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
