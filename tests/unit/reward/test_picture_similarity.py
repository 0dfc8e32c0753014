"""PSNR and SSIM of pictures against numbers worked by hand (DD-28a)."""

import numpy as np
import pytest
import torch
from torch import Tensor

from wm_nodes.core.seeding import torch_stream
from wm_nodes.reward.picture_similarity import psnr_db, ssim

C1, C2 = 1e-4, 9e-4


def pictures(count: int = 3, height: int = 24, width: int = 32) -> Tensor:
    generator = torch_stream(0, "test_similarity")
    return torch.randint(0, 256, (count, height, width, 3), generator=generator, dtype=torch.uint8)


def flat(level: int, height: int = 16, width: int = 20) -> Tensor:
    return torch.full((1, height, width, 3), level, dtype=torch.uint8)


def noisy(images: Tensor, amount: int) -> Tensor:
    noise = torch.randint(-amount, amount + 1, images.shape, generator=torch_stream(0, "test_noise"))
    return (images.int() + noise).clamp(0, 255).to(torch.uint8)


def test_equal_pictures_have_an_ssim_of_one_and_80_db() -> None:
    assert ssim(pictures(), pictures()).tolist() == [1.0] * 3 and psnr_db(pictures(), pictures()).tolist() == [80.0] * 3


def test_flat_pictures_differ_in_their_means_alone() -> None:
    """(2 a b + C1) / (a^2 + b^2 + C1), a = 1, b = 0.2, but for the rounding of float32 variances beside C2; an error of
    0.8 is 1.94 dB."""
    assert float(ssim(flat(255), flat(51))) == pytest.approx((0.4 + C1) / (1.04 + C1), abs=2e-4)
    assert float(psnr_db(flat(255), flat(51))) == pytest.approx(-20 * np.log10(0.8), abs=1e-4)
    assert float(ssim(flat(0), flat(255))) == pytest.approx(C1 / (1 + C1), abs=2e-4)


def test_stripes_and_their_negative_are_as_unlike_as_can_be() -> None:
    """A picture of one window: means m and 1 - m, variances v and covariance -v, by the window's weights."""
    stripes = torch.zeros(1, 11, 11, 3, dtype=torch.uint8)
    stripes[:, :, ::2] = 255
    weights = np.exp(-np.arange(-5, 6) ** 2 / 4.5)
    m = weights[::2].sum() / weights.sum()
    v = m * (1 - m)
    wanted = (2 * v + C1) * (C2 - 2 * v) / ((m * m + (1 - m) ** 2 + C1) * (2 * v + C2))
    assert float(ssim(stripes, 255 - stripes)) == pytest.approx(wanted, abs=1e-5) and wanted < -0.9


def test_ssim_is_the_mean_over_all_windows_of_11_pixels() -> None:
    first, second = pictures(1), noisy(pictures(1), 60)
    windows = [np.lib.stride_tricks.sliding_window_view(some[0].double().numpy() / 255, (11, 11), (0, 1))
               for some in (first, second)]
    side = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5**2))
    weights = np.outer(side, side) / side.sum() ** 2
    x, y = windows
    mx, my = ((some * weights).sum((-1, -2)) for some in windows)
    dx, dy = x - mx[..., None, None], y - my[..., None, None]
    vx, vy, c = ((product * weights).sum((-1, -2)) for product in (dx * dx, dy * dy, dx * dy))
    wanted = ((2 * mx * my + C1) * (2 * c + C2) / ((mx**2 + my**2 + C1) * (vx + vy + C2))).mean()
    assert float(ssim(first, second)) == pytest.approx(wanted, abs=1e-5)


def test_both_fall_with_noise_are_symmetric_and_do_not_depend_on_the_other_pairs() -> None:
    images = pictures(70)  # more than a batch
    for measure in (ssim, psnr_db):
        curve = [float(measure(images, noisy(images, amount)).mean()) for amount in (0, 5, 20, 60, 120)]
        assert curve == sorted(curve, reverse=True) and len(set(curve)) == 5, measure
        other = noisy(images, 20)
        torch.testing.assert_close(measure(images, other), measure(other, images))
        torch.testing.assert_close(measure(images, other)[66:], measure(images[66:], other[66:]))


def test_a_picture_smaller_than_the_window_has_the_largest_odd_one_that_fits() -> None:
    small, other = pictures(2, 8, 30), noisy(pictures(2, 8, 30), 40)
    found = ssim(small, other)
    assert ssim(small, small).tolist() == [1.0, 1.0] and bool(((found > 0) & (found < 1)).all())
    assert float(ssim(flat(255, 1, 1), flat(51, 1, 1))) == pytest.approx((0.4 + C1) / (1.04 + C1), abs=1e-6)


@pytest.mark.parametrize("wrong", [pictures(2), pictures().float() / 255, pictures()[0]])
def test_what_is_no_pair_of_uint8_pictures_is_refused(wrong: Tensor) -> None:
    for measure in (ssim, psnr_db):
        with pytest.raises(ValueError, match="two uint8"):
            measure(pictures(), wrong)
