"""Rows of the tables of docs/results/roboscape.md; what they are about stands in pages.yaml."""

from collections.abc import Sequence
from statistics import fmean

from benchmarks.environments.roboscape import LABELS, MODEL, PAPER, TASKS, gain, success_of
from benchmarks.tables.table import Rows, read
from wm_nodes.config.scenes import splits

REWARDS, TABLE_1 = "roboscape_rewards.json", "roboscape_table1.json"
DOMAINS = "IND", "OOD"


def table_1() -> Rows:
    found = read(TABLE_1)["rows"]
    for task in [one for one in TASKS if any(row["task"] == one for row in found)]:
        for training, label in LABELS.items():
            of = sorted((r for r in found if (r["task"], r["model"]) == (task, training)), key=lambda r: r["seed"])
            if of:
                papers = (PAPER.get((training, domain)) for domain in DOMAINS)
                yield (
                    task, label, *(by_seed([success_of(row, domain) for row in of]) for domain in DOMAINS),
                    ", ".join("yes" if row["accepted"] else "no" for row in of) if training == MODEL else "",
                    *("" if paper is None else paper[TASKS.index(task)] for paper in papers),
                )


def by_seed(rates: Sequence[float]) -> str:
    text = f"{fmean(rates):.1f}"
    return text if len(rates) == 1 else f"{text} ({', '.join(f'{rate:.0f}' for rate in rates)})"


def table_1_gains() -> Rows:
    found = read(TABLE_1)["rows"]
    for base in (one for one in LABELS if one != MODEL):
        for task in [one for one in TASKS if any(row["task"] == one for row in found)]:
            if text := gain([row for row in found if row["task"] == task], base):
                yield task, LABELS[base], text


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
