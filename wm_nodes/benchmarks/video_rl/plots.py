"""The benchmark's results as pictures: diversity against noise, learning, choices in pairs, reward hacking, cost. PNG,
beside their JSON.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.video_rl.comparison import SamplerComparison, value
from benchmarks.video_rl.learning import alarms
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.reports.figures import COLOURS, add_legend, make_figure, save_figure, style_axes

FAMILIES = {"CPS": "o", "DynDiff literal": "v", "DynDiff gated, rms": "s", "DynDiff sparse, rms": "D"}
"""Samplers that share a colour, with the marker of their points."""
CURVE_SEEDS = 5
"""Arms with fewer seeds get a dot each, no curve."""
SAID = {
    "reward_path": "reward over the training", "reward": "reward after", "tracking_path": "tracking over the training",
    "tracking": "tracking after", "object_cm": "object error after, cm", "tool_cm": "tool error after, cm",
    "psnr_db": "PSNR after, dB",
}
MORE_COLOURS = ("#444444", "#c2a000", "#1fa0b0", "#b04080", "#7a4a1f", "#6fae2a")
SMOOTHED = 5
"""Buffers behind each point of a curve of rollouts: each has a few scenes only."""


def plot_diversity(rows: Sequence[dict[str, Any]], path: Path, seed: int) -> None:
    """Diversity (DD-19) with its 95 % interval against the noise a sampler spends; the two regimes of initial noise."""
    figure = make_figure(10.5, 4.2)
    for axes, shared in zip(figure.subplots(1, 2, sharey=True), (False, True), strict=True):
        whose = "shared" if shared else "own"
        style_axes(axes, f"{whose} initial noise", "noise spent, rms(std) / s", "diversity (DD-19)")
        for (family, marker), colour in zip(FAMILIES.items(), COLOURS, strict=True):
            points = sorted(
                (np.mean(row["noise_share"]), *bootstrap_mean(row["diversity"], seed=seed))
                for row in rows if row["shared_noise"] == shared and family_of(row["sampler"]) == family
            )
            if not points:
                continue
            x, mean, low, high = np.array(points).T
            axes.errorbar(
                x, mean, (mean - low, high - mean), marker=marker, markersize=5, elinewidth=0.8, capsize=2,
                linewidth=0 if family == "DynDiff literal" else 1.4, color=colour, label=family,
            )
        ode = [np.mean(row["diversity"]) for row in rows if row["sampler"] == "ODE" and row["shared_noise"] == shared]
        if ode:
            axes.axhline(ode[0], color="gray", linewidth=1, linestyle=":", label="ODE")
        add_legend(axes, "lower right")
    save_figure(figure, path)


def plot_learning(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Held-out reward above the base model's over the buffers, mean with standard error over seeds; every sampler's
    mean over its training, by seed; and the diversity of its rollouts over the buffers, where the rows have it."""
    spread = [row for row in rows if "rollout_diversity" in row["buffers"]]
    figure = make_figure(17.0 if spread else 12.0, 4.8)
    left, right, *more = figure.subplots(1, 3 if spread else 2, width_ratios=(1.15, 1, 1)[: 3 if spread else 2])
    samplers = sorted({row["sampler"] for row in rows}, key=lambda sampler: np.mean(_gains(rows, sampler)))
    style_axes(left, f"samplers with {CURVE_SEEDS} seeds or more", "buffers", "held-out reward above the base model's")
    shown = [sampler for sampler in samplers if len(_gains(rows, sampler)) >= CURVE_SEEDS]
    colours = dict(zip(shown, (*COLOURS, *MORE_COLOURS), strict=False))
    for sampler in shown:
        trained = [row["evaluations"] for row in rows if row["sampler"] == sampler]
        curves = np.array([[point["reward"] for point in evaluations] for evaluations in trained])
        curves -= curves[:, :1]
        x = [point["iteration"] for point in trained[0]]
        mean, error = curves.mean(0), curves.std(0, ddof=1) / len(curves) ** 0.5
        colour = colours.get(sampler, "gray")
        left.plot(x, mean, color=colour, linewidth=1.6, label=f"{sampler} ({len(curves)})")
        left.fill_between(x, mean - error, mean + error, color=colour, alpha=0.12, linewidth=0)
    if shown:
        add_legend(left, "upper left", fontsize=7.5)
    style_axes(right, "mean over a training; a dot per seed", "held-out reward above the base model's", "")
    for place, sampler in enumerate(samplers):
        values = _gains(rows, sampler)
        right.plot(values, [place] * len(values), ".", color=colours.get(sampler, "gray"), alpha=0.5, markersize=7)
        right.plot(np.mean(values), place, "|", color="black", markersize=13, markeredgewidth=1.8)
    right.set_yticks(range(len(samplers)), samplers, fontsize=8)
    for axes in more:
        style_axes(axes, f"rollouts, mean of {SMOOTHED} buffers and over seeds", "buffers", "diversity (DD-19)")
        for place, sampler in enumerate(dict.fromkeys(row["sampler"] for row in spread)):
            mean = np.mean([row["buffers"]["rollout_diversity"] for row in spread if row["sampler"] == sampler], 0)
            size = min(SMOOTHED, len(mean))
            smooth = np.convolve(mean, np.full(size, 1 / size), "valid")
            axes.plot(np.arange(size, len(mean) + 1), smooth, color=COLOURS[place % len(COLOURS)], label=sampler)
        add_legend(axes, fontsize=7.5)
    save_figure(figure, path)


def plot_comparisons(comparisons: Sequence[SamplerComparison], path: Path) -> None:
    """Each pair's difference with its 95 % interval, a panel per measure."""
    measures = tuple(comparisons[0].differences)
    figure = make_figure(3.0 * len(measures), 1.4 + 0.45 * len(comparisons))
    places = range(len(comparisons))
    for axes, measure in zip(figure.subplots(1, len(measures), sharey=True), measures, strict=True):
        style_axes(axes, SAID.get(measure, measure), "difference, 95 % t interval", "")
        axes.locator_params(axis="x", nbins=4)
        axes.axvline(0, color="gray", linewidth=1)
        for place, row in zip(places, comparisons, strict=True):
            difference = row.differences[measure]
            colour = COLOURS[1] if difference.separable else COLOURS[0]
            axes.plot((difference.low, difference.high), (place, place), color=colour, linewidth=1.6)
            axes.plot(difference.mean, place, "o", color=colour, markersize=5)
        labels = [f"{row.sampler}\n- {row.base} ({len(row.seeds)} seeds)" for row in comparisons]
        axes.set_yticks(places, labels, fontsize=8)
    axes.invert_yaxis()
    save_figure(figure, path)


def plot_cost(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Seconds of forward, KL and backward on one buffer, stacked, and the bytes kept, per model and anchor."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    figure = make_figure(5.2 * len(models), 3.6)
    for axes, model in zip(np.atleast_1d(figure.subplots(1, len(models))), models, strict=True):
        style_axes(axes, f"{model}: training on one buffer", "KL anchor, MiB kept beside the weights", "seconds")
        mine = [row for row in rows if row["model"] == model]
        bottom = np.zeros(len(mine))
        for part, colour in zip(("forward", "kl", "backward"), COLOURS, strict=False):
            seconds = np.array([row[f"{part}_s"] for row in mine])
            axes.bar(range(len(mine)), seconds, 0.6, bottom, color=colour, label=part)
            bottom += seconds
        axes.set_xticks(range(len(mine)), [f"{row['anchor']}\n{row['bytes'] / 2**20:.2f} MiB" for row in mine])
        axes.set_ylim(top=1.2 * bottom.max())
        add_legend(axes, "upper center", ncols=3)
    save_figure(figure, path)


def plot_hacking(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """The reward that trains beside the truths held out of it, a panel per trial; mean over seeds, thin lines each."""
    figure = make_figure(12.0, 4.0)
    samplers = list(dict.fromkeys(row["sampler"] for row in rows))
    truths = {"obeyed": COLOURS[0], "mass": COLOURS[1]}
    for axes, sampler in zip(np.atleast_1d(figure.subplots(1, len(samplers), sharey=True)), samplers, strict=True):
        mine = [row for row in rows if row["sampler"] == sampler]
        proxy, fired = mine[0]["plan"]["proxy"], sum(bool(alarms(row)) for row in mine)
        style_axes(axes, f"{sampler}: alarm in {fired} of {len(mine)} runs", "buffers", "held-out scenes")
        for name, colour in {proxy: COLOURS[2], **truths}.items():
            for row in mine:
                x, y = zip(*((point["iteration"], point[name]) for point in row["evaluations"]), strict=True)
                axes.plot(x, y, color=colour, linewidth=0.6, alpha=0.4)
            mean = np.mean([[point[name] for point in row["evaluations"]] for row in mine], 0)
            label = f"{name} (trains)" if name == proxy else name
            axes.plot(x, mean, color=colour, linewidth=2, linestyle="-" if name == proxy else "--", label=label)
        axes.set_ylim(bottom=0)
        add_legend(axes, "lower left")
    save_figure(figure, path)


def family_of(sampler: str) -> str:
    """The family of a sampler of the diversity experiment."""
    if not sampler.startswith("DynDiff"):
        return sampler.split()[0]
    return f"DynDiff {sampler.split()[2]} rms" if sampler.endswith("rms") else "DynDiff literal"


def _gains(rows: Sequence[dict[str, Any]], sampler: str) -> list[float]:
    """Mean reward over each training of the sampler, less that of its start."""
    return [value(row, "reward_path") - row["evaluations"][0]["reward"] for row in rows if row["sampler"] == sampler]
