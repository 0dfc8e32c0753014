"""The judge's probe: it reads positions off pictures that it was not trained on, and nothing else depends on it."""

from pathlib import Path

import numpy as np
import pytest
from pushing_scene import episode, stacked_scene

from wm_nodes.config.load import load_config
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.positions import columns_of, probe_targets
from wm_nodes.world_model.training.position_probe import train_position_probe

OBJECT = columns_of("push_cube", "object")


def arrays(count: int, first_seed: int = 0) -> EpisodeArrays:
    return stacked_scene([episode(first_seed + i) for i in range(count)], ("push_cube", "reach"))


@pytest.mark.slow
def test_a_trained_probe_reads_positions_of_episodes_it_has_not_seen(tmp_path: Path) -> None:
    config = load_config("base", {"tokenizer.num_iterations": 500, "tokenizer.batch_size": 32})
    probe, metrics = train_position_probe(arrays(120), config, 0, tmp_path)
    assert metrics["error_m"] < 0.02
    unseen = arrays(16, 10_000)
    truth = probe_targets(unseen.ground_truth, "push_cube")
    assert probe.read(unseen.images).shape == truth.shape
    guess = np.linalg.norm(truth[..., OBJECT] - truth[..., OBJECT].mean((0, 1)), axis=-1).mean()
    found = np.linalg.norm((probe.read(unseen.images) - truth)[..., OBJECT], axis=-1).mean()
    assert found < 0.35 * guess


def test_episodes_without_ground_truth_are_refused() -> None:
    known = arrays(2)
    unknown = EpisodeArrays(**{**known.__dict__, "ground_truth": np.full_like(known.ground_truth, np.nan)})
    with pytest.raises(ValueError, match="no recorded frame has ground truth"):
        train_position_probe(unknown, load_config("base", {}), 0, None)


def test_enlarged_images_are_read_as_they_are_and_another_shape_is_refused() -> None:
    probe, image = PositionProbe(16, 32), arrays(1).images[:, 0, :16]
    enlarged = image.repeat(3, axis=1).repeat(3, axis=2)
    np.testing.assert_allclose(probe.read(enlarged), probe.read(image), atol=1e-4)
    with pytest.raises(ValueError, match=r"16, 32, 3\) or enlarged, got \(1, 64, 64, 3\)"):
        probe.read(np.zeros((1, 64, 64, 3), np.uint8))
