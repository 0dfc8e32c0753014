"""Rotation vectors out of + - * / and square roots alone, so that numpy and torch agree to the bit on every device.

Rotation vector (..., 3): axis times angle, rad. Quaternion (..., 4): w x y z. xp: numpy, or torch for tensors; both are
computed in float64. A library's sine differs from another's in its last bit, which imagined episodes must not.
"""

from math import factorial
from typing import Any

TERMS = 14
"""Of each series: exact to float64 up to the half angle pi / 2."""


def to_quaternion(xp: Any, vector: Any) -> Any:
    """exp(v / 2) = (cos |v / 2|, v / 2 sin |v / 2| / |v / 2|)."""
    half = xp.asarray(vector, dtype=xp.float64) * 0.5
    x, y, z = half[..., 0], half[..., 1], half[..., 2]
    squared = x * x + y * y + z * z
    cos, sinc = (_series(squared, [(-1) ** k / factorial(2 * k + odd) for k in range(TERMS)]) for odd in (0, 1))
    return xp.stack([cos, x * sinc, y * sinc, z * sinc], -1)


def to_vector(xp: Any, quaternion: Any) -> Any:
    """The inverse of to_quaternion, angle at most pi.

    tan(a / 4) = |q_xyz| / (1 + w); two more halvings, tan(a / 2) = tan a / (1 + sqrt(1 + tan^2 a)), and the series of
    the arctangent is short.
    """
    q = xp.asarray(quaternion, dtype=xp.float64)
    q = xp.where(q[..., :1] < 0, -q, q)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    scale = 1 / (1 + w)
    squared = (x * x + y * y + z * z) * scale * scale
    for _ in range(2):
        halving = 1 / (1 + xp.sqrt(1 + squared))
        scale, squared = scale * halving, squared * halving * halving
    scale = 16 * scale * _series(squared, [(-1) ** k / (2 * k + 1) for k in range(TERMS)])
    return xp.stack([x * scale, y * scale, z * scale], -1)


def multiply(xp: Any, left: Any, right: Any) -> Any:
    """The quaternion of rotating by `right`, then by `left`, about fixed axes."""
    a, b, c, d = (left[..., i] for i in range(4))
    w, x, y, z = (right[..., i] for i in range(4))
    return xp.stack([
        a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w,
    ], -1)


def _series(squared: Any, coefficients: list[float]) -> Any:
    """sum c_k squared^k, by Horner's rule."""
    total = squared * 0 + coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * squared + coefficient
    return total
