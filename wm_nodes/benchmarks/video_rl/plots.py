"""The benchmark's results as pictures: diversity against noise, learning, choices in pairs, reward hacking, cost. PNG,
beside their JSON.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.video_rl.comparison import SamplerComparison, gains, paired_interval
from benchmarks.video_rl.learning import alarms
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.reports.figures import COLOURS, add_legend, make_figure, save_figure, style_axes

FAMILIES = {"CPS": "o", "DynDiff literal": "v", "DynDiff gated, rms": "s", "DynDiff sparse, rms": "D"}
"""Samplers that share a colour, with the marker of their points."""
BAND_SEEDS = 3
"""A curve of fewer has no interval: that of two seeds is twelve times their standard error."""
DIVERSITY = "rollout_diversity"
SAID = {
    "reward_path": "reward over the training", "reward": "reward after", "tracking_path": "tracking over the training",
    "tracking": "tracking after", "object_cm": "object error after, cm", "tool_cm": "tool error after, cm",
    "psnr_db": "PSNR after, dB",
}
MORE_COLOURS = ("#444444", "#c2a000", "#1fa0b0", "#b04080", "#7a4a1f", "#6fae2a")
EXECUTED, LAST = "executed_success", 3
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
    """Gain of held-out reward and obedience over the buffers, mean over seeds with its 95 % t interval; every sampler's
    gain at the end, a dot per seed; and the diversity of its rollouts over the buffers, where the rows have it."""
    trained = {name: [row for row in rows if row["sampler"] == name] for name in dict.fromkeys(map(_sampler, rows))}
    trained = dict(sorted(trained.items(), key=lambda item: np.mean(_last_gains(item[1]))))
    colours = dict(zip(reversed(trained), (*COLOURS, *MORE_COLOURS), strict=False))
    spread = {name: mine for name, mine in trained.items() if all(DIVERSITY in row["buffers"] for row in mine)}
    figure = make_figure(22.0 if spread else 17.0, 4.8)
    *courses, ends = figure.subplots(1, 3) if not spread else figure.subplots(1, 4)[[0, 1, 3, 2]]
    for axes, measure in zip(courses, ("reward", "obeyed"), strict=False):
        style_axes(axes, f"{measure}: mean over seeds, 95 % t interval", "buffers", "held-out scenes, less before")
        axes.axhline(0, color="gray", linewidth=1)
        for name in reversed(trained):
            _draw_course(axes, trained[name], measure, f"{name}, n = {len(trained[name])}", colours.get(name, "gray"))
    add_legend(courses[0], "upper left", fontsize=7.5)
    style_axes(ends, "reward after the training; a dot per seed", "held-out scenes, less before", "")
    for place, (name, mine) in enumerate(trained.items()):
        values = _last_gains(mine)
        ends.plot(values, [place] * len(values), ".", color=colours.get(name, "gray"), alpha=0.5, markersize=7)
        ends.plot(np.mean(values), place, "|", color="black", markersize=13, markeredgewidth=1.8)
    ends.set_yticks(range(len(trained)), list(trained), fontsize=8)
    for axes in courses[2:]:
        style_axes(axes, f"rollouts, mean of {SMOOTHED} buffers and over seeds", "buffers", "diversity (DD-19)")
        for name, mine in spread.items():
            mean = np.mean([row["buffers"][DIVERSITY] for row in mine], 0)
            size = min(SMOOTHED, len(mean))
            smooth = np.convolve(mean, np.full(size, 1 / size), "valid")
            axes.plot(np.arange(size, len(mean) + 1), smooth, color=colours.get(name, "gray"))
    save_figure(figure, path)


def plot_courses(rows: Sequence[dict[str, Any]], path: Path, measures: Sequence[str]) -> None:
    """A panel per held-out score: its course over the buffers, mean over seeds with its 95 % t interval."""
    names = list(dict.fromkeys(map(_sampler, rows)))
    colours = dict(zip(names, (*COLOURS, *MORE_COLOURS), strict=False))
    figure = make_figure(5.2 * len(measures), 4.2)
    panels = np.atleast_1d(figure.subplots(1, len(measures)))
    for axes, measure in zip(panels, measures, strict=True):
        style_axes(axes, SAID.get(measure, measure), "buffers", "held out, less before")
        axes.axhline(0, color="gray", linewidth=1)
        for name in names:
            mine = [row for row in rows if row["sampler"] == name]
            _draw_course(axes, mine, measure, f"{name}, n = {len(mine)}", colours.get(name, "gray"))
    add_legend(panels[0], "upper left", fontsize=7.5)
    save_figure(figure, path)


def plot_proxy(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Truth against what was paid: for each training a line from the first buffer's reward and the base's executed
    success (hollow) to the mean reward of the last LAST buffers and the executed success after; a colour per sampler.
    """
    names = list(dict.fromkeys(map(_sampler, rows)))
    figure = make_figure(7.5, 4.8)
    axes = figure.subplots()
    style_axes(axes, "every training from first to last", "reward paid in training", "success executed in simulator")
    for name, colour in zip(names, (*COLOURS, *MORE_COLOURS), strict=False):
        for row in (row for row in rows if row["sampler"] == name):
            paid = row["buffers"]["reward_mean"]
            start = paid[0], row["measured_before"][EXECUTED]
            end = float(np.mean(paid[-LAST:])), row["measured_after"][EXECUTED]
            axes.plot(*zip(start, end, strict=True), color=colour, alpha=0.35, linewidth=0.9)
            axes.plot(*start, "o", color=colour, markersize=4, fillstyle="none")
            axes.plot(*end, "o", color=colour, markersize=5)
        axes.plot([], [], "o", color=colour, label=f"{name}, n = {sum(row['sampler'] == name for row in rows)}")
    axes.set_ylim(0, 1)
    axes.set_xlim(right=1.02)
    add_legend(axes, "upper left", fontsize=7.5)
    save_figure(figure, path)


def _draw_course(axes: Any, rows: Sequence[dict[str, Any]], measure: str, label: str, colour: str) -> None:
    """The mean gain at every evaluation and, from BAND_SEEDS seeds on, its interval."""
    x = [point["iteration"] for point in rows[0]["evaluations"]]
    courses = np.array(gains(rows, measure))
    axes.plot(x, courses.mean(0), color=colour, linewidth=1.6, label=label)
    if len(rows) >= BAND_SEEDS:
        found = [paired_interval(values) for values in courses.T.tolist()]
        axes.fill_between(x, [one.low for one in found], [one.high for one in found], color=colour, alpha=0.12, lw=0)


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


def _sampler(row: dict[str, Any]) -> str:
    return str(row["sampler"])


def _last_gains(rows: Sequence[dict[str, Any]]) -> list[float]:
    return [course[-1] for course in gains(rows, "reward")]
