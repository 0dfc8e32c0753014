"""What was paid against what was executed, as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.video_rl.tables import last_measured
from wm_nodes.reports.figures import COLOURS, add_legend, make_figure, save_figure, style_axes

MORE_COLOURS = ("#444444", "#c2a000", "#1fa0b0", "#b04080", "#7a4a1f", "#6fae2a")
EXECUTED, LAST = "executed_success", 3


def plot_proxy(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Truth against what was paid: for each training a line from the first buffer's reward and the base's executed
    success (hollow) to the mean reward of the last LAST buffers and the executed success after; a colour per sampler.
    """
    names = list(dict.fromkeys(str(row["sampler"]) for row in rows))
    figure = make_figure(7.5, 4.8)
    axes = figure.subplots()
    paid_as = "reward paid in training, weights summing to 1"
    style_axes(axes, "every training from first to last", paid_as, "success executed in simulator")
    for name, colour in zip(names, (*COLOURS, *MORE_COLOURS), strict=False):
        for row in (row for row in rows if row["sampler"] == name):
            paid = np.array(row["buffers"]["reward_mean"]) / sum(weight for _, weight in row["plan"]["rewards"])
            start = paid[0], row["measured"]["0"][EXECUTED]
            end = paid[-LAST:].mean(), last_measured(row)[EXECUTED]
            axes.plot(*zip(start, end, strict=True), color=colour, alpha=0.35, linewidth=0.9)
            axes.plot(*start, "o", color=colour, markersize=4, fillstyle="none")
            axes.plot(*end, "o", color=colour, markersize=5)
        axes.plot([], [], "o", color=colour, label=f"{name}, n = {sum(row['sampler'] == name for row in rows)}")
    axes.set_ylim(0, 1)
    axes.set_xlim(right=1.02)
    add_legend(axes, "upper left", fontsize=7.5)
    save_figure(figure, path)
