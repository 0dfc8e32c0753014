"""What the segmenter says of pictures is the likeliest class of its logits, pixel by pixel."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from wm_nodes.judge.evidence.segmentation import MULTIPLE_PX, Segmenter


@pytest.mark.parametrize(("height", "width"), [(96, 96), (50, 71), (8, 16), (3, 5)])
def test_masks_are_the_argmax_of_the_logits_of_the_picture_continued_at_its_edges(height: int, width: int) -> None:
    torch.manual_seed(0)
    images = np.random.default_rng(0).integers(0, 256, (3, height, width, 3), np.uint8)
    pixels = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
    padding = (0, -width % MULTIPLE_PX, 0, -height % MULTIPLE_PX)
    padded = F.pad(pixels, padding, mode="replicate")
    model = Segmenter().requires_grad_(False)
    model.out.bias -= model(padded).mean((0, 2, 3)).repeat_interleave(4)  # every class is likeliest somewhere
    expected = model(padded)[:, :, :height, :width].argmax(1).numpy()
    assert len(np.unique(expected)) == 4
    found = model.masks(images)
    assert found.dtype == np.uint8 and np.array_equal(found, expected)
