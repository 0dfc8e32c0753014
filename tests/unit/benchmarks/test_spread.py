"""Diversity of videos (DD-19): limits, and the mean over frames and pairs."""

import math

import pytest
import torch
from video_toys import randn

from benchmarks.video_rl.spread import rollout_diversity


def test_identical_videos_have_diversity_zero_and_opposite_ones_two() -> None:
    video = randn(1, 4, 16, seed=1)
    assert rollout_diversity(video.repeat(5, 1, 1)) == pytest.approx(0.0, abs=1e-6)
    assert rollout_diversity(torch.cat([video, -3 * video])) == pytest.approx(2.0, abs=1e-6)
    assert rollout_diversity(torch.eye(3)[:, None]) == pytest.approx(1.0, abs=1e-6)


def test_diversity_is_one_less_the_mean_over_frames_and_pairs_of_the_cosine() -> None:
    """Frames of very different lengths count alike."""
    features = randn(4, 5, 16, seed=2) * torch.tensor([1.0, 100, 0.01, 3, 7]).view(1, 5, 1)
    pairs = [(i, j) for i in range(4) for j in range(i)]
    cosines = [torch.cosine_similarity(features[i], features[j], dim=1).mean() for i, j in pairs]
    assert rollout_diversity(features) == pytest.approx(1 - float(torch.stack(cosines).mean()), abs=1e-6)


def test_diversity_does_not_depend_on_the_order_of_the_videos() -> None:
    features = randn(6, 3, 8, seed=3)
    assert rollout_diversity(features) == pytest.approx(rollout_diversity(features[torch.tensor([3, 0, 5, 1, 4, 2])]))


def test_diversity_needs_two_videos_and_finite_features() -> None:
    with pytest.raises(ValueError, match=r"at least two videos .* got 1"):
        rollout_diversity(torch.ones(1, 2, 3))
    with pytest.raises(ValueError, match="not finite"):
        rollout_diversity(torch.full((2, 2, 3), math.nan))
