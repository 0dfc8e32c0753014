"""Features of pictures and the diversity of clips measured with them."""

from pathlib import Path

import pytest
import torch
from model_folders import make_model_folder
from torch import Tensor

from benchmarks.video_rl.diversity import MARGIN_PX, frame_features, group_diversity, moving_part
from wm_nodes.world_model import load_model_folder


def square(place: int) -> Tensor:
    """A clip of 3 frames of 64 x 128 px: a red square on grey that moves right from `place`."""
    clip = torch.full((3, 64, 128, 3), 120, dtype=torch.uint8)
    for frame, picture in enumerate(clip):
        picture[20:36, place + 4 * frame : place + 4 * frame + 16] = torch.tensor([200, 30, 30], dtype=torch.uint8)
    return clip


def test_equal_clips_have_no_diversity_and_other_ones_have(tmp_path: Path) -> None:
    tokenizer = load_model_folder(make_model_folder(tmp_path / "model")).tokenizer
    same, other = torch.stack([square(10)] * 3), torch.stack([square(10), square(60), square(90)])
    found = frame_features(same[0], tokenizer)
    assert found.shape[0] == 3 and found.dtype == torch.float32
    assert group_diversity(same, tokenizer) == pytest.approx(0, abs=1e-6)
    assert group_diversity(other, tokenizer) > 1e-4


def test_the_moving_part_is_where_the_square_was_or_comes_and_a_margin_around() -> None:
    where = moving_part(square(40))[:, :, 0]
    rows, columns = torch.nonzero(where, as_tuple=True)
    assert (int(rows.min()), int(rows.max())) == (20 - MARGIN_PX, 35 + MARGIN_PX)
    assert (int(columns.min()), int(columns.max())) == (40 - MARGIN_PX, 40 + 8 + 15 + MARGIN_PX)
