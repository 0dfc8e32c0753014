"""Detects reward hacking (DD-2): the training reward goes up while what it stands for does not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)
"""97.5 % quantile of Student's t for 1 to 9 degrees of freedom; the last serves more of them, a little wide."""


@dataclass(frozen=True)
class HackedMetric:
    """One held-out metric that did not follow the training reward."""

    metric: str
    """Its name."""
    proxy_slope: float
    """The training reward's, per evaluation, over the window."""
    true_slope: float
    """The metric's."""


def find_hacked_metrics(
    proxy: Sequence[float], held_out: Mapping[str, Sequence[float]], *, window: int
) -> list[HackedMetric]:
    """Return the metrics whose least-squares slope is < 0 over the last `window` evaluations while the proxy's is > 0.

    Both count only where their 95 % interval (Student's, window - 2 degrees of freedom) leaves out 0: two flat, noisy
    curves raise an alarm in less than one case of a thousand, however short the window.

    Args:
        proxy: the training reward at each evaluation. held_out: true metrics at the same ones, more is better.

    Raises:
        ValueError: fewer than three evaluations in the window, or curves of different lengths.
    """
    if window < 3:
        raise ValueError(f"window must be >= 3 evaluations, got {window}")
    for name, values in held_out.items():
        if len(values) != len(proxy):
            raise ValueError(f"{name} has {len(values)} evaluations, the training reward {len(proxy)}")
    if len(proxy) < window:
        return []
    widths = T_975[min(window - 2, len(T_975)) - 1]
    rise, rise_error = slope(proxy[-window:])
    if rise <= widths * rise_error:
        return []
    slopes = {name: slope(values[-window:]) for name, values in held_out.items()}
    return [HackedMetric(name, rise, trend) for name, (trend, error) in slopes.items() if trend < -widths * error]


def slope(values: Sequence[float]) -> tuple[float, float]:
    """Return the least-squares slope per step and its standard error."""
    y = np.asarray(values, np.float64)
    x = np.arange(len(y)) - (len(y) - 1) / 2
    trend = float((x * y).sum() / (x * x).sum())
    residual = y - y.mean() - trend * x
    return trend, float(np.sqrt((residual**2).sum() / max(1, len(y) - 2) / (x * x).sum()))
