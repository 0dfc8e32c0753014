"""Features of pictures and the diversity of clips measured with them."""

import json
from pathlib import Path

import pytest
import torch
from model_folders import make_model_folder
from safetensors.torch import load_file, save_file
from torch import Tensor

from benchmarks.video_rl.diversity import MARGIN_PX, group_diversity, moving_part
from wm_nodes.video_rl.frame_features import (
    CentredPixels,
    FrameFeatures,
    RandomFeatures,
    TokenizerFeatures,
    load_backbone,
)
from wm_nodes.world_model import load_model_folder

transformers = pytest.importorskip("transformers")


def square(place: int) -> Tensor:
    """A clip of 3 frames of 64 x 128 px: a red square on grey that moves right from `place`."""
    clip = torch.full((3, 64, 128, 3), 120, dtype=torch.uint8)
    for frame, picture in enumerate(clip):
        picture[20:36, place + 4 * frame : place + 4 * frame + 16] = torch.tensor([200, 30, 30], dtype=torch.uint8)
    return clip


def tiny_backbone(folder: Path) -> Path:
    torch.manual_seed(0)
    config = transformers.DINOv3ViTConfig(
        image_size=64, patch_size=16, hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=2
    )
    transformers.DINOv3ViTModel(config).save_pretrained(folder)
    return folder


def features(kind: str, folder: Path) -> FrameFeatures:
    if kind == "dinov3":
        return load_backbone(tiny_backbone(folder / "dinov3"))
    if kind == "tokenizer":
        return TokenizerFeatures(load_model_folder(make_model_folder(folder / "model")).tokenizer, "model")
    return {"pixels": CentredPixels(), "random": RandomFeatures()}[kind]


@pytest.mark.parametrize("kind", ["pixels", "random", "tokenizer", "dinov3"])
def test_equal_clips_have_no_diversity_and_other_ones_have(kind: str, tmp_path: Path) -> None:
    measure = features(kind, tmp_path)
    same, other = torch.stack([square(10)] * 3), torch.stack([square(10), square(60), square(90)])
    assert measure(same[0]).shape[0] == 3 and measure(same[0]).dtype == torch.float32
    assert group_diversity(same, measure) == pytest.approx(0, abs=1e-6)
    assert group_diversity(other, measure) > 1e-4
    assert torch.equal(measure(other[1]), features(kind, tmp_path / "again")(other[1]))


def test_every_kind_says_what_it_is(tmp_path: Path) -> None:
    names = {kind: features(kind, tmp_path).name for kind in ("pixels", "random", "tokenizer", "dinov3")}
    assert names["dinov3"] == "dinov3_vit of dinov3" and names["tokenizer"] == "frozen tokenizer of model"
    assert "no learned backbone" in names["pixels"] and "no learned backbone" in names["random"]


def test_a_backbone_sees_the_pictures_in_its_own_size_mean_and_deviation(tmp_path: Path) -> None:
    folder = tiny_backbone(tmp_path / "dinov3")
    (folder / "preprocessor_config.json").write_text(json.dumps({"image_mean": [0.5] * 3, "image_std": [0.5] * 3}))
    model = transformers.DINOv3ViTModel.from_pretrained(folder).eval()
    frame = torch.randint(0, 256, (1, 64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = model(pixel_values=frame.permute(0, 3, 1, 2) / 255 * 2 - 1).pooler_output
    torch.testing.assert_close(load_backbone(folder)(frame), expected, atol=1e-4, rtol=1e-4)


def test_a_folder_that_is_no_whole_vision_model_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"has no config\.json"):
        load_backbone(tmp_path)
    folder = tiny_backbone(tmp_path / "cut")
    tensors = load_file(folder / "model.safetensors")
    tensors.pop("norm.weight")
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})
    with pytest.raises(ValueError, match=r"lacks weights of dinov3_vit: norm\.weight"):
        load_backbone(folder)
    config = transformers.BertConfig(vocab_size=9, hidden_size=8, num_hidden_layers=1, num_attention_heads=1)
    transformers.BertModel(config).save_pretrained(tmp_path / "text")
    with pytest.raises(ValueError, match="bert, which takes no pictures"):
        load_backbone(tmp_path / "text")


def test_the_moving_part_is_where_the_square_was_or_comes_and_a_margin_around() -> None:
    where = moving_part(square(40))[:, :, 0]
    rows, columns = torch.nonzero(where, as_tuple=True)
    assert (int(rows.min()), int(rows.max())) == (20 - MARGIN_PX, 35 + MARGIN_PX)
    assert (int(columns.min()), int(columns.max())) == (40 - MARGIN_PX, 40 + 8 + 15 + MARGIN_PX)
