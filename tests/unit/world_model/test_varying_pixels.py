"""What a tokenizer loses is seen in the pixels that vary between episodes at the same step."""

import numpy as np
import pytest

from wm_nodes.core.types import UInt8Array
from wm_nodes.world_model.validation.pictures import varying_error

COUNT, SIZE = 40, 20


def recorded() -> UInt8Array:
    """A wall of one of two greys, and before it a dot of four pixels at one of two places, independent of the wall."""
    frames = np.full((COUNT, SIZE, SIZE, 3), 100, np.uint8)
    for number, frame in enumerate(frames):
        frame[:3] = 20 if number < COUNT // 2 else 250
        left = 4 if number % 2 else 12
        frame[10:12, left : left + 2] = 130
    return frames


def test_recorded_frames_explain_everything_the_mean_frame_nothing_and_half_its_contrast_three_quarters() -> None:
    real = recorded()
    mean = np.broadcast_to(real.mean(0).astype(np.uint8), real.shape)
    half = ((real.astype(np.float32) + mean) / 2).astype(np.uint8)
    assert varying_error(real, real) == 0
    assert varying_error(mean, real) == pytest.approx(1, abs=1e-3)
    assert varying_error(half, real) == pytest.approx(0.25, abs=0.01)


def test_a_lost_dot_is_seen_beside_a_wall_that_varies_more() -> None:
    without = recorded()
    without[:, 10:12] = 100
    error, variance = (np.square(np.float32(recorded()) - shown).mean() for shown in (without, recorded().mean(0)))
    assert error < 0.02 * variance, "all pixels together do not show that it is lost"
    assert varying_error(without, recorded()) == pytest.approx(2)  # less than the mean frame, which has half of it


def test_pixels_that_are_alike_in_all_episodes_count_for_nothing() -> None:
    noisy = recorded()
    noisy[:, 15:] += np.random.default_rng(0).integers(0, 60, noisy[:, 15:].shape, dtype=np.uint8)
    assert varying_error(noisy, recorded()) == 0
    assert np.isnan(varying_error(noisy[:, 15:], recorded()[:, 15:]))


def test_few_episodes_decide_nothing() -> None:
    assert np.isfinite(varying_error(recorded()[:24], recorded()[:24]))
    assert np.isnan(varying_error(recorded()[:23], recorded()[:23]))
