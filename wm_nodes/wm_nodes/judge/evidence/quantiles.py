"""Medians and quantiles of small arrays: the bits of NumPy's without its checks, which take longer than the sorting."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def median(values: NDArray[Any]) -> NDArray[Any]:
    """numpy.median over the last axis, of finite floats (..., N >= 1)."""
    high = values.shape[-1] // 2
    low = (values.shape[-1] - 1) // 2
    ordered = np.partition(values, (low, high), -1)
    middle: NDArray[Any] = (ordered[..., low] + ordered[..., high]) / 2
    return middle


def quantile(values: NDArray[Any], share: float) -> float:
    """numpy.quantile of all finite floats, N >= 1, linear between neighbours."""
    at = (values.size - 1) * share
    low = math.floor(at)
    high, part = min(low + 1, values.size - 1), at - low
    ordered = np.partition(values, (low, high), None)
    a, b = ordered[low], ordered[high]
    step = float(b - a)
    return float(b) - step * (1 - part) if part >= 0.5 else float(a) + step * part
