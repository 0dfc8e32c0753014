"""How alike two pictures are, in what shows alone (DD-28a). Shapes: N pairs, H W 3 image. Equal pictures: 80 dB, 1."""

from collections.abc import Callable

import torch
from torch import Tensor

WINDOW_PX, WINDOW_STD_PX = 11, 1.5
"""Side of the Gaussian window of SSIM, and its standard deviation."""
C1, C2 = 0.01**2, 0.03**2
"""(K L)^2 for pixels in [0, 1]."""
LEAST_ERROR = 1e-8
BATCH = 64


def psnr_db(images: Tensor, others: Tensor) -> Tensor:
    """Return -10 log10 of the mean squared error of pixels in [0, 1], at most 80 dB, float32 (N,), of uint8 images.

    Raises:
        ValueError: other types or shapes.
    """

    def part(x: Tensor, y: Tensor) -> Tensor:
        return -10 * (x - y).square().mean((1, 2, 3)).clamp_min(LEAST_ERROR).log10()

    return _in_parts(part, images, others)


def ssim(images: Tensor, others: Tensor) -> Tensor:
    """Return the structural similarity of uint8 images, in [-1, 1], float32 (N,).

    (2 m_x m_y + C1)(2 s_xy + C2) / ((m_x^2 + m_y^2 + C1)(s_x^2 + s_y^2 + C2)), mean over channels and all places of the
    window that lie in the picture; m, s: mean and (co)variance in the window. From "Image Quality Assessment: From
    Error Visibility to Structural Similarity", without enlarging or shrinking. In a picture smaller than the window its
    side is the largest odd number that fits.

    Raises:
        ValueError: other types or shapes.
    """

    def part(x: Tensor, y: Tensor) -> Tensor:
        mean_x, mean_y, mean_xx, mean_yy, mean_xy = _window_means(torch.stack([x, y, x * x, y * y, x * y]))
        squares, product = mean_x * mean_x + mean_y * mean_y, mean_x * mean_y
        alike = (2 * product + C1) * (2 * (mean_xy - product) + C2)
        found: Tensor = alike / ((squares + C1) * (mean_xx + mean_yy - squares + C2))
        return found.mean((1, 2, 3))

    return _in_parts(part, images, others)


def _window_means(values: Tensor) -> Tensor:
    """Gaussian means (..., h, w) of values (..., H, W) around each place that the whole window has, as two products of
    matrices: four times as fast as convolutions of one channel."""
    H, W = values.shape[-2:]
    side = min(WINDOW_PX, H - 1 + H % 2, W - 1 + W % 2)
    offsets = torch.arange(side, device=values.device) - side // 2
    weights = torch.exp(-offsets.square() / (2 * WINDOW_STD_PX**2))
    weights = weights / weights.sum()
    rows, columns = (_banded(weights, size) for size in (H, W))
    means: Tensor = rows @ values @ columns.T
    return means


def _banded(weights: Tensor, size: int) -> Tensor:
    """The matrix (size - side + 1, size) whose row i has the weights from column i on."""
    places = torch.arange(size, device=weights.device)
    index = places - places[: size - len(weights) + 1].unsqueeze(1)
    inside = (index >= 0) & (index < len(weights))
    return torch.where(inside, weights[index.clamp(0, len(weights) - 1)], 0.0)


def _in_parts(measure: Callable[[Tensor, Tensor], Tensor], images: Tensor, others: Tensor) -> Tensor:
    """Measure float (N, 3, H, W) in [0, 1], BATCH pairs at a time."""
    if images.dtype != torch.uint8 or others.dtype != torch.uint8 or images.shape != others.shape or images.ndim != 4:
        raise ValueError(
            f"similarity needs two uint8 (N, H, W, 3) tensors of one shape, got {images.dtype} {tuple(images.shape)} "
            f"and {others.dtype} {tuple(others.shape)}"
        )
    parts = (
        measure(*(some[i : i + BATCH].permute(0, 3, 1, 2).float() / 255 for some in (images, others)))
        for i in range(0, len(images), BATCH)
    )
    return torch.cat(list(parts))
