"""The course of a training as a picture, from the run's metrics.jsonl."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

PANELS = (
    ("success_rate", "imagined success (share of episodes)", (0.0, 1.0)),
    ("mean_return", "imagined return (mean per episode)", None),
    ("kl_reference", "KL to the SFT policy (nats per step)", None),
    ("loss_value", "value loss (Huber)", None),
)
"""Metric, title, fixed limits of the y axis."""
COLOURS = ("#2a7f5f", "#3567a8", "#b5562b", "#7a4fa0")


def curves(metrics_file: Path, path: Path) -> Path | None:
    """Draw imagined success, return, KL to the SFT policy and value loss over updates; returns the PNG.

    Returns None, and draws nothing, where no line of the file carries any of them. Values that were written as null
    leave a gap.
    """
    series = {name: read_series(metrics_file, name) for name, _, _ in PANELS}
    if not any(series.values()):
        return None
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 5.4), dpi=110, layout="constrained", facecolor="white")
    for axes, (name, title, limits), colour in zip(figure.subplots(2, 2).flat, PANELS, COLOURS, strict=True):
        _panel(axes, series[name], title, limits, colour)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp.png")
    figure.savefig(temporary)
    temporary.replace(path)
    return path


def read_series(metrics_file: Path, name: str) -> list[tuple[int, float]]:
    """(step, value) of one metric in order; the last line of a step wins, as a resumed run may repeat steps."""
    if not metrics_file.is_file():
        return []
    values: dict[int, float] = {}
    for text in metrics_file.read_text(encoding="utf-8").splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue  # a line cut by a crash
        if name in line:
            values[int(line["step"])] = float("nan") if line[name] is None else float(line[name])
    return sorted(values.items())


def _panel(
    axes: Any, points: Sequence[tuple[int, float]], title: str, limits: tuple[float, float] | None, colour: str
) -> None:
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("policy update", fontsize=8)
    axes.tick_params(labelsize=8)
    if not points:
        axes.text(0.5, 0.5, "not recorded", ha="center", va="center", transform=axes.transAxes, color="gray")
        return
    steps, values = zip(*points, strict=True)
    axes.plot(steps, values, color=colour, linewidth=1.6, marker="o", markersize=2.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if limits is not None:
        axes.set_ylim(limits[0] - 0.03, limits[1] + 0.03)
