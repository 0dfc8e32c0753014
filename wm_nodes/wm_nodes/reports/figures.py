"""One way to make, style and save a figure. matplotlib is imported when the first figure is made."""

import io
from pathlib import Path
from typing import Any

from wm_nodes.core.files import write_atomic

COLOURS = ("#2a7f5f", "#3567a8", "#b5562b", "#7a4fa0")


def make_figure(width: float, height: float, dpi: int = 80) -> Any:
    """An empty white figure. width, height: inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained", facecolor="white")


def style_axes(axes: Any, title: str, x: str, y: str = "") -> None:
    """Set title, axis labels and a light grid."""
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def add_legend(axes: Any, place: str = "best", **options: Any) -> None:
    """Add a small legend without a frame."""
    axes.legend(loc=place, **{"fontsize": 8, "frameon": False, **options})


def save_figure(figure: Any, path: Path) -> None:
    """Write a PNG, complete or not at all; its folder is made."""
    png = io.BytesIO()
    figure.savefig(png, format="png")
    write_atomic(path, png.getvalue())
