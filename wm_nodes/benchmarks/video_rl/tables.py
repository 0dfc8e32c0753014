"""The benchmark's tables on the console."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.video_rl.comparison import Difference, SamplerComparison
from benchmarks.video_rl.learning import alarms
from wm_nodes.core.statistics import bootstrap_mean

COURSE = ("noise_share", "rollout_diversity")
SCORES = ("tracking", "object_cm", "tool_cm", "psnr_db")
LAST_UPDATE = ("clip_low_share_2", "clip_high_share_2", "kl_2")


def diversity_table(rows: Sequence[dict[str, Any]], seed: int) -> Table:
    table = _table(
        "diversity (DD-19) and quality, mean over contexts with 95 % bootstrap interval",
        ("sampler", "initial noise"), ("noise rms/s", "diversity", "moving part", "reward std", "reward", "bg", "mass"),
    )
    for row in rows:
        mean, low, high = bootstrap_mean(row["diversity"], seed=seed)
        shown = ("diversity_dynamic", "reward_std", "reward", "background", "mass")
        values = [sum(row[name]) / len(row[name]) for name in shown]
        table.add_row(
            row["sampler"], _regime(row), f"{row['noise_share']:.3f}",
            f"{mean:.3f} ({low:.3f} to {high:.3f})", *(f"{value:.4f}" for value in values),
        )
    return table


def clip_table(rows: Sequence[dict[str, Any]], seed: int) -> Table:
    table = _table(
        f"clips of recorded contexts, {rows[0]['features']}; means over contexts", ("sampler", "initial noise"),
        ("noise rms/s", "diversity (DD-19)", "moving part", "object spread, cm", "reward std", "tracking", "scenery"),
    )
    for row in rows:
        mean, low, high = bootstrap_mean(row["diversity"], seed=seed)
        shown = ("diversity_dynamic", "object_spread_cm", "reward_std", "tracking", "scenery")
        table.add_row(
            row["sampler"], _regime(row), f"{_average(row, 'noise_share'):.3f}",
            f"{mean:.4f} ({low:.4f} to {high:.4f})", *(f"{_average(row, name):.4f}" for name in shown),
        )
    return table


def clip_comparison_table(comparisons: Sequence[dict[str, Any]]) -> Table:
    table = _table(
        "DynDiff - CPS, paired over contexts, 95 % bootstrap interval", ("sampler", "base", "initial noise"),
        ("noise", "diversity (DD-19)", "moving part", "object spread, cm", "tracking"),
    )
    for row in comparisons:
        shown = ("diversity", "diversity_dynamic", "object_spread_cm", "tracking")
        intervals = ("{:+.4f} ({:+.4f} to {:+.4f})".format(*row[name]) for name in shown)
        noise = "{:.2f}, {:.2f}".format(*row["noise_share"])
        table.add_row(row["sampler"], row["base"], _regime(row), noise, *intervals)
    return table


def _regime(row: dict[str, Any]) -> str:
    return "shared" if row["shared_noise"] else "own"


def _average(row: dict[str, Any], name: str) -> float:
    return float(sum(row[name]) / len(row[name]))


def training_table(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per sampler, means over its seeds: held-out scenes before and after; noise and diversity of its
    rollouts, means over the buffers; the second update of the last buffer that was not skipped.
    """
    table = _table(
        "held-out scenes, ODE, before and after; mean over seeds", ("sampler",),
        ("seeds", "reward", "obeyed", "bg", "mass", "noise", "diversity", "clip low/high @2", "KL @2", "seconds"),
    )
    for sampler in dict.fromkeys(row["sampler"] for row in rows):
        mine = [row for row in rows if row["sampler"] == sampler]
        first, last = ([row["evaluations"][i] for row in mine] for i in (0, -1))
        update = {name: np.mean([_last(row["buffers"][name]) for row in mine]) for name in LAST_UPDATE}
        course = (f"{_mean(first, name):.3f} -> {_mean(last, name):.3f}" for name in ("reward", "obeyed"))
        table.add_row(
            sampler, str(len(mine)), *course,
            f"{_mean(last, 'background'):.4f}", f"{_mean(last, 'mass'):.3f}",
            *(_over_buffers(mine, name) for name in COURSE),
            f"{update['clip_low_share_2']:.2f}/{update['clip_high_share_2']:.2f}", f"{update['kl_2']:.1e}",
            f"{np.mean([sum(row['seconds'].values()) for row in mine]):.0f}",
        )
    return table


def clip_training_table(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per training: held-out contexts after - before, paired over them."""
    table = _table(
        "held-out contexts by ODE, after - before, 95 % bootstrap interval over the contexts", ("sampler",),
        ("seed", "noise rms/s", "tracking before", *SCORES, "seconds"),
    )
    for row in rows:
        changes = (np.subtract(row["after"][name], row["before"][name]) for name in SCORES)
        intervals = ("{:+.3f} ({:+.3f} to {:+.3f})".format(*bootstrap_mean(one, seed=row["seed"])) for one in changes)
        table.add_row(
            row["sampler"], str(row["seed"]), _over_buffers([row], "noise_share"),
            f"{_average(row['before'], 'tracking'):.3f}", *intervals, f"{sum(row['seconds'].values()):.0f}",
        )
    return table


def _last(course: Sequence[float | None]) -> float:
    """The last value that is known; NaN where none is, of a training whose buffers were all skipped."""
    return next((value for value in reversed(course) if value is not None), np.nan)


def _over_buffers(rows: Sequence[dict[str, Any]], name: str) -> str:
    """Mean over seeds and buffers; nothing where a file of an earlier version lacks it."""
    found = [np.mean(row["buffers"][name]) for row in rows if name in row["buffers"]]
    return f"{np.mean(found):.3f}" if len(found) == len(rows) else ""


def comparison_table(comparisons: Sequence[SamplerComparison]) -> Table:
    measures = tuple(comparisons[0].differences) if comparisons else ()
    table = _table(
        "sampler - base on the same seeds: mean, 95 % t interval, * if beside 0; _path: mean over a training",
        ("sampler", "base"), ("seeds", *measures),
    )
    for row in comparisons:
        table.add_row(row.sampler, row.base, str(len(row.seeds)), *(_shown(row.differences[name]) for name in measures))
    return table


def _shown(difference: Difference) -> str:
    star = "*" if difference.separable else ""
    return f"{difference.mean:+.4f} ({difference.low:+.4f}, {difference.high:+.4f}){star}"


def resolution_table(rows: Sequence[dict[str, Any]]) -> Table:
    measures = ("tracking", "object_cm", "tool_cm", "psnr_db")
    table = _table("clips at other picture sizes, means over contexts", ("side, px", "shown"), measures)
    for row in rows:
        table.add_row(str(row["side_px"]), row["shown"], *(f"{_average(row, name):.3f}" for name in measures))
    return table


def hacking_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Per training: the reward that trained it and the truths, before and after, and what the detector (DD-2) names."""
    table = _table(
        "reward hacking (DD-2), held-out scenes", ("trained on",),
        ("seed", "that reward", "obeyed", "mass", "background", "falls while it rises"),
    )
    for row in rows:
        first, last, proxy = row["evaluations"][0], row["evaluations"][-1], row["plan"]["proxy"]
        shown = (f"{first[name]:.4g} -> {last[name]:.4g}" for name in (proxy, "obeyed", "mass", "background"))
        table.add_row(row["sampler"], str(row["seed"]), *shown, ", ".join(alarms(row)) or "no alarm")
    return table


def cost_table(rows: Sequence[dict[str, Any]], repeats: int) -> Table:
    numbers = ("forward, s", "KL, s", "backward, s", "kept beside the weights, MiB")
    table = _table(f"KL anchors, median of {repeats} turns on one buffer", ("model", "anchor"), numbers)
    for row in rows:
        seconds = (f"{row[name]:.3f}" for name in ("forward_s", "kl_s", "backward_s"))
        table.add_row(row["model"], row["anchor"], *seconds, f"{row['bytes'] / 2**20:.2f}")
    return table


def rollout_table(rows: Sequence[dict[str, Any]], repeats: int) -> Table:
    numbers = ("by CPS, s", "by DynDiff, s", "ratio", "mask", "caching", "both")
    table = _table(f"What a rollout of 32 videos spends on mask and caching, median of {repeats}", ("model",), numbers)
    for row in rows:
        shares = row["mask_share"], row["cache_share"], row["mask_share"] + row["cache_share"]
        seconds = f"{row['cps_s']:.3f}", f"{row['rollout_s']:.3f}", f"{row['over_cps']:.3f}"
        table.add_row(row["model"], *seconds, *(f"{share:.2%}" for share in shares))
    return table


def _mean(rows: Sequence[dict[str, Any]], name: str) -> float:
    return float(np.mean([row[name] for row in rows]))


def _table(title: str, words: Sequence[str], numbers: Sequence[str]) -> Table:
    table = Table(title=title)
    for name in words:
        table.add_column(name)
    for name in numbers:
        table.add_column(name, justify="right")
    return table
