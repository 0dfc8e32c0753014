"""The reader of success, on small pictures whose left half is bright where the task is done."""

from pathlib import Path

import numpy as np
import pytest
import torch
from video_toys import small_codec, toy_clips

from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.success_reader import (
    SUCCESS_MANIFEST,
    WEIGHTS,
    load_success_reader,
    save_success_reader,
    score_reader,
    train_success_reader,
)


def recorded(count: int, seed: int) -> tuple[Clips, np.ndarray]:  # type: ignore[type-arg]
    """Clips of 3 pictures of 16 x 32, a third of which show the task done, and which do."""
    rng = np.random.default_rng(seed)
    done = rng.random((count, 3)) < 1 / 3
    frames = rng.integers(60, 100, (count, 3, 16, 32, 3), np.uint8)
    frames[done, :, :16] += 100
    truth = np.zeros((count, 3, len(GROUND_TRUTH_NAMES)), np.float32)
    truth[..., GROUND_TRUTH_NAMES.index("goal_x")] = np.where(done, 0, 1)
    return toy_clips(torch.from_numpy(frames), torch.zeros(count, 2, 1), truth), done


def test_a_reader_learns_from_labels_and_comes_back_from_its_folder_as_it_was(tmp_path: Path) -> None:
    (clips, _), codec = recorded(60, 0), small_codec()
    reader = train_success_reader(clips, codec, 40, seed=0)
    unseen, done = recorded(30, 1)
    scores = score_reader(reader, unseen.frames, done)
    assert scores["precision"] > 0.9 and scores["recall"] > 0.9
    again = train_success_reader(clips, codec, 40, seed=0)
    np.testing.assert_array_equal(again.read(unseen.frames), reader.read(unseen.frames))
    save_success_reader(tmp_path, reader, "push_cube", {"seed": 0})
    loaded = load_success_reader(tmp_path, "push_cube")
    assert loaded.threshold == reader.threshold
    np.testing.assert_array_equal(loaded.read(unseen.frames), reader.read(unseen.frames))
    with pytest.raises(ValueError, match=r"16, 32, 3\) or enlarged, got \(8, 32, 3\)"):
        loaded.read(np.zeros((8, 32, 3), np.uint8))
    with pytest.raises(ModelFolderError, match="of push_cube, not reach"):
        load_success_reader(tmp_path, "reach")
    (tmp_path / WEIGHTS).write_bytes(b"half of it")
    with pytest.raises(ModelFolderError, match="sha256 differs"):
        load_success_reader(tmp_path, "push_cube")
    (tmp_path / SUCCESS_MANIFEST).unlink()
    with pytest.raises(ModelFolderError, match="trained success reader"):
        load_success_reader(tmp_path, "push_cube")


def test_too_few_episodes_are_refused() -> None:
    clips, _ = recorded(4, 0)
    with pytest.raises(ValueError, match=r"4 episodes.*record more"):
        train_success_reader(clips, small_codec(), 1, seed=0)
