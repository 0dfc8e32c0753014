"""The benchmark's tables on the console."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.video_rl.comparison import GAINS, SamplerComparison, gains
from wm_nodes.core.statistics import MeanInterval, bootstrap_mean, t_interval
from wm_nodes.reports.console_table import estimate, make_table

SCORES = ("tracking", "object_cm", "tool_cm", "psnr_db")


def diversity_table(rows: Sequence[dict[str, Any]], seed: int) -> Table:
    shown = ("diversity_dynamic", "reward_std", "reward", "background", "mass")
    return _table(
        "diversity (DD-19) and quality, mean over contexts with 95 % bootstrap interval", ("sampler", "initial noise"),
        ("noise rms/s", "diversity", "moving part", "reward std", "reward", "bg", "mass"),
        (_diversity_cells(row, seed, ".3f", shown) for row in rows),
    )


def clip_table(rows: Sequence[dict[str, Any]], seed: int) -> Table:
    shown = ("diversity_dynamic", "object_spread_cm", "reward_std", "tracking", "scenery")
    return _table(
        "clips of recorded contexts, by tokens; means over contexts", ("sampler", "initial noise"),
        ("noise rms/s", "diversity (DD-19)", "moving part", "object spread, cm", "reward std", "tracking", "scenery"),
        (_diversity_cells(row, seed, ".4f", shown) for row in rows),
    )


def _diversity_cells(row: dict[str, Any], seed: int, form: str, shown: Sequence[str]) -> tuple[str, ...]:
    return (
        row["sampler"], _regime(row), f"{np.mean(row['noise_share']):.3f}",
        estimate(bootstrap_mean(row["diversity"], seed=seed), form), *(f"{np.mean(row[name]):.4f}" for name in shown),
    )


def clip_comparison_table(comparisons: Sequence[dict[str, Any]]) -> Table:
    shown = ("diversity", "diversity_dynamic", "object_spread_cm", "tracking")
    cells = (
        (
            row["sampler"], row["base"], _regime(row), "{:.2f}, {:.2f}".format(*row["noise_share"]),
            *(estimate(row[name]) for name in shown),
        )
        for row in comparisons
    )
    return _table(
        "DynDiff - CPS, paired over contexts, 95 % bootstrap interval", ("sampler", "base", "initial noise"),
        ("noise", "diversity (DD-19)", "moving part", "object spread, cm", "tracking"), cells,
    )


def clip_training_table(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per training: held-out contexts after - before, paired over them."""
    cells = []
    for row in rows:
        changes = (np.subtract(row["after"][name], row["before"][name]) for name in SCORES)
        cells.append((
            row["sampler"], row["seed"], f"{np.mean(row['buffers']['noise_share']):.3f}",
            f"{np.mean(row['before']['tracking']):.3f}",
            *(estimate(bootstrap_mean(change, seed=row["seed"]), "+.3f") for change in changes),
            f"{sum(row['seconds'].values()):.0f}",
        ))
    return _table(
        "held-out contexts by ODE, after - before, 95 % bootstrap interval over the contexts", ("sampler",),
        ("seed", "noise rms/s", "tracking before", *SCORES, "seconds"), cells,
    )


def gain_table(rows: Sequence[dict[str, Any]], scores: Sequence[str] = GAINS) -> Table:
    """One line per sampler: held-out scores before, and what its training changed; of one seed the change alone."""
    cells = []
    for sampler in dict.fromkeys(row["sampler"] for row in rows):
        mine = [row for row in rows if row["sampler"] == sampler]
        befores = (np.mean([row["evaluations"][0][name] for row in mine]) for name in scores)
        changes = (_change_text([course[-1] for course in gains(mine, name)]) for name in scores)
        cells.append((sampler, len(mine), *(f"{old:.3f} {new}" for old, new in zip(befores, changes, strict=True))))
    return _table(
        "held out: mean before, and after - before on the same seed with its 95 % t interval over seeds, * if beside 0",
        ("sampler",), ("seeds", *scores), cells,
    )


def measured_table(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per sampler: metrics that nothing trained on, mean over seeds before, and change after the last buffer,
    with its interval."""
    known = [row for row in rows if row.get("measured")]
    names, cells = tuple(known[0]["measured"]["0"]) if known else (), []
    for sampler in dict.fromkeys(row["sampler"] for row in known):
        mine = [(row["measured"]["0"], last_measured(row)) for row in known if row["sampler"] == sampler]
        texts = (
            f"{np.mean([before[name] for before, _ in mine]):.3f} "
            f"{_change_text([after[name] - before[name] for before, after in mine])}" for name in names
        )
        cells.append((sampler, len(mine), *texts))
    return _table(
        "metrics that nothing trained on: mean before, and change with its 95 % t interval over seeds", ("sampler",),
        ("seeds", *names), cells,
    )


def last_measured(row: Mapping[str, Any]) -> dict[str, float]:
    """The metrics of a training after its last buffer."""
    measured: dict[str, dict[str, float]] = row["measured"]
    return measured[max(measured, key=int)]


def comparison_table(comparisons: Sequence[SamplerComparison]) -> Table:
    measures = tuple(comparisons[0].differences) if comparisons else ()
    cells = (
        (row.sampler, row.base, len(row.seeds), *(_difference_text(row.differences[name]) for name in measures))
        for row in comparisons
    )
    return _table(
        "sampler - base on the same seeds: mean, 95 % t interval, * if beside 0; _path: mean over a training",
        ("sampler", "base"), ("seeds", *measures), cells,
    )


def resolution_table(rows: Sequence[dict[str, Any]]) -> Table:
    cells = ((row["side_px"], row["shown"], *(f"{np.mean(row[name]):.3f}" for name in SCORES)) for row in rows)
    return _table("clips at other picture sizes, means over contexts", ("side, px", "shown"), SCORES, cells)


def hacking_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Per training: the reward that trained it and the truths, before and after, and what the detector (DD-2) names."""
    cells = []
    for row in rows:
        first, last, proxy = row["evaluations"][0], row["evaluations"][-1], row["plan"]["proxy"]
        shown = (f"{first[name]:.4g} -> {last[name]:.4g}" for name in (proxy, "obeyed", "mass", "background"))
        cells.append((row["sampler"], row["seed"], *shown, ", ".join(row["hacked"]) or "no alarm"))
    return _table(
        "reward hacking (DD-2), held-out scenes", ("trained on",),
        ("seed", "that reward", "obeyed", "mass", "background", "falls while it rises"), cells,
    )


def cost_table(rows: Sequence[dict[str, Any]], repeats: int) -> Table:
    parts = ("forward_s", "kl_s", "backward_s")
    cells = (
        (row["model"], row["anchor"], *(f"{row[name]:.3f}" for name in parts), f"{row['bytes'] / 2**20:.2f}")
        for row in rows
    )
    numbers = ("forward, s", "KL, s", "backward, s", "kept beside the weights, MiB")
    return _table(f"KL anchors, median of {repeats} turns on one buffer", ("model", "anchor"), numbers, cells)


def rollout_table(rows: Sequence[dict[str, Any]], repeats: int) -> Table:
    cells = []
    for row in rows:
        shares = row["mask_share"], row["cache_share"], row["mask_share"] + row["cache_share"]
        seconds = (f"{row[name]:.3f}" for name in ("cps_s", "rollout_s", "over_cps"))
        cells.append((row["model"], *seconds, *(f"{share:.2%}" for share in shares)))
    title = f"What a rollout of 32 videos spends on mask and caching, median of {repeats}"
    return _table(title, ("model",), ("by CPS, s", "by DynDiff, s", "ratio", "mask", "caching", "both"), cells)


def _table(title: str, words: Sequence[str], numbers: Sequence[str], rows: Any) -> Table:
    return make_table(title, (*words, *numbers), rows, left=words)


def _regime(row: dict[str, Any]) -> str:
    return "shared" if row["shared_noise"] else "own"


def _change_text(changes: Sequence[float]) -> str:
    return _difference_text(t_interval(changes)) if len(changes) > 1 else f"{changes[0]:+.4f}"


def _difference_text(difference: MeanInterval) -> str:
    star = "*" if difference.separable else ""
    return f"{difference.mean:+.4f} ({difference.low:+.4f}, {difference.high:+.4f}){star}"
