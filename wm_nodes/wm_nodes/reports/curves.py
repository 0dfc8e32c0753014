"""The course of a training as a picture, from the run's metrics.jsonl."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wm_nodes.core.files import text_lines
from wm_nodes.reports.figures import COLOURS, add_legend, make_figure, save_figure, style_axes


@dataclass(frozen=True)
class Panel:
    """One diagram."""

    title: str
    """Above it."""
    lines: Mapping[str, str]
    """Metric to its label in the legend, "" for none; "section/metric" takes it from that section only."""
    limits: tuple[float, float] | None = None
    """Fixed ones of the y axis."""


POLICY_PANELS = (
    Panel("imagined success (share of episodes)", {"success_rate": ""}, (0.0, 1.0)),
    Panel("imagined return (mean per episode)", {"mean_return": ""}),
    Panel("KL to the SFT policy (nats per step)", {"kl_reference": ""}),
    Panel("value loss (Huber)", {"loss_value": ""}),
    Panel(
        "exploit meter: success of the same episodes (share)",
        {f"exploit_meter/{name}_success": name for name in ("imagined", "replayed", "real")}, (0.0, 1.0),
    ),
    Panel(
        "exploit meter: imagined success (share)",
        {f"exploit_meter/{name}": name for name in ("precision", "recall")}, (0.0, 1.0),
    ),
)


def curves(
    metrics_file: Path, path: Path, panels: Sequence[Panel] = POLICY_PANELS, *, step: str = "policy update"
) -> Path | None:
    """Draw the panels over the steps of the metrics, two in a row; returns the PNG.

    Returns None, and draws nothing, where no line of the file carries any of them. Values that were written as null
    leave a gap; a metric without any number is neither drawn nor in the legend, nor a panel without any. step: said
    under each panel.
    """
    read = [(panel, {name: read_series(metrics_file, name) for name in panel.lines}) for panel in panels]
    drawn = [(panel, lines) for panel, lines in read if any(lines.values())]
    if not drawn:
        return None
    rows = -(-len(drawn) // 2)
    figure = make_figure(10.5, 2.7 * rows, dpi=110)
    diagrams = list(figure.subplots(rows, 2, squeeze=False).flat)
    for unused in diagrams[len(drawn) :]:
        unused.set_axis_off()
    for index, (axes, (panel, lines)) in enumerate(zip(diagrams, drawn, strict=False)):
        _panel(axes, panel, lines, step, index)
    save_figure(figure, path)
    return path


def read_series(metrics_file: Path, name: str) -> list[tuple[int, float]]:
    """(step, value) of a metric ("section/metric": of that section only) in order; the last line of a step wins, as a
    resumed run may repeat steps."""
    if not metrics_file.is_file():
        return []
    section, _, metric = name.rpartition("/")
    values: dict[int, float] = {}
    for text in text_lines(metrics_file.read_bytes()):
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue  # a line cut by a crash
        if metric in line and section in ("", line["section"]):
            values[int(line["step"])] = float("nan") if line[metric] is None else float(line[metric])
    return sorted(values.items())


def _panel(axes: Any, panel: Panel, series: Mapping[str, Sequence[tuple[int, float]]], step: str, index: int) -> None:
    style_axes(axes, panel.title, step)
    drawn = {name for name, points in series.items() if any(math.isfinite(value) for _, value in points)}
    if not drawn:
        axes.text(0.5, 0.5, "not recorded", ha="center", va="center", transform=axes.transAxes, color="gray")
        return
    for number, (name, points) in enumerate(series.items()):
        if name not in drawn:
            continue
        colour = COLOURS[(index + number) % len(COLOURS)]
        steps, values = zip(*points, strict=True)
        axes.plot(steps, values, color=colour, linewidth=1.6, marker="o", markersize=2.5, label=panel.lines[name])
    if any(panel.lines[name] for name in drawn):
        add_legend(axes)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if panel.limits is not None:
        low, high = panel.limits
        axes.set_ylim(low - 0.03, high + 0.03)
