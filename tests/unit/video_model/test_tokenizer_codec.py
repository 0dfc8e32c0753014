"""A world model's tokenizer as the codec of a video model."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from model_folders import make_model_folder
from torch import Tensor
from torch.nn.functional import interpolate

from wm_nodes.config.load import load_config, load_video_config
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.seeding import torch_stream
from wm_nodes.video_model import NetworkSettings, VideoNetwork
from wm_nodes.video_model.folder import load_video_folder, save_video_folder
from wm_nodes.video_model.tokenizer_codec import TokenizerCodec, codec_of_world_model
from wm_nodes.video_rl.pretraining import shipped_video_model
from wm_nodes.world_model import load_model_folder


@pytest.fixture(scope="module")
def world_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_model_folder(tmp_path_factory.mktemp("world_model"))


def clips(height: int = 64) -> Tensor:
    generator = torch_stream(0, "test_clips")
    return torch.randint(0, 256, (2, 3, height, 128, 3), generator=generator, dtype=torch.uint8)


def test_it_codes_each_frame_as_the_tokenizer_does(world_model: Path) -> None:
    codec, tokenizer = codec_of_world_model(world_model), load_model_folder(world_model).tokenizer
    frames = clips()
    latents = codec.encode(frames)
    assert latents.shape == (2, codec.channels, 3, 64 // codec.patch, 128 // codec.patch)
    tokens = tokenizer.encode(frames[1])
    torch.testing.assert_close(latents[1].permute(1, 2, 3, 0).flatten(1, 2), tokens)
    decoded = codec.decode(latents)
    assert torch.equal(decoded[1], tokenizer.decode(tokenizer.normalise(tokens)))


def test_its_latents_can_be_trained_on(world_model: Path) -> None:
    latents = codec_of_world_model(world_model).encode(clips())
    weight = torch.ones((), requires_grad=True)
    (weight * latents).square().sum().backward()  # type: ignore[no-untyped-call]
    assert weight.grad is not None and float(weight.grad) > 0


def test_a_video_folder_holds_all_of_it(world_model: Path, tmp_path: Path) -> None:
    codec = codec_of_world_model(world_model)
    network = VideoNetwork(NetworkSettings(codec.channels, action_dim=3, width=8, depth=1, patch=1, change_std=0.5))
    save_video_folder(tmp_path, codec, network, {"stride": 2, "num_conditioning": 1}, {"seed": 0})
    loaded = load_video_folder(tmp_path)
    assert loaded.network.settings == network.settings and isinstance(loaded.codec, TokenizerCodec)
    assert torch.equal(loaded.codec.encode(clips()), codec.encode(clips()))


def test_beside_its_world_model_the_folder_needs_no_codec_of_its_own(world_model: Path, tmp_path: Path) -> None:
    shutil.copytree(world_model, tmp_path / "model")
    codec = codec_of_world_model(world_model)
    network = VideoNetwork(NetworkSettings(codec.channels, action_dim=3, width=8, depth=1, patch=1))
    folder = save_video_folder(tmp_path / "model" / "video_model", codec, network, {"stride": 2}, {"seed": 0})
    (folder / "codec.safetensors").unlink()
    assert torch.equal(load_video_folder(folder).codec.encode(clips()), codec.encode(clips()))
    with torch.no_grad():
        codec.tokenizer.background.add_(0.1)
    save_video_folder(folder, codec, network, {"stride": 2}, {"seed": 0})
    (folder / "codec.safetensors").unlink()
    with pytest.raises(ModelFolderError, match="made with another tokenizer"):
        load_video_folder(folder)
    shutil.move(folder, tmp_path / "alone")
    with pytest.raises(ModelFolderError, match=r"codec\.safetensors is missing"):
        load_video_folder(tmp_path / "alone")


def test_a_folder_of_the_codec_that_is_gone_is_refused_by_name(world_model: Path, tmp_path: Path) -> None:
    codec = codec_of_world_model(world_model)
    folder = save_video_folder(
        tmp_path / "old", codec, VideoNetwork(NetworkSettings(codec.channels, 3, width=8, depth=1)), {"stride": 2}, {}
    )
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["codec"] = {"kind": "patch", "patch": 4, "channels": 6}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ModelFolderError, match=r"old has a codec of kind patch, .* reads tokenizer; train it anew"):
        load_video_folder(folder)


def test_the_shipped_video_model_serves_the_recommended_settings_and_no_others() -> None:
    shipped = shipped_video_model(load_video_config("recommended"))
    assert shipped is not None and isinstance(shipped.codec, TokenizerCodec)
    assert shipped.manifest["heldout"]["tool_cm"] < 0.2 * shipped.manifest["heldout"]["copy_tool_cm"]
    assert shipped_video_model(load_video_config("recommended", {"model.width": 64})) is None
    for other in ("pull_cube", "reach"):
        assert shipped_video_model(load_video_config("recommended", {"task": other})) is None


@pytest.mark.parametrize("size", [(64, 128), (96, 192), (128, 256)])
def test_a_picture_of_any_size_comes_back(size: tuple[int, int]) -> None:
    shipped = shipped_video_model(load_video_config("recommended"))
    assert shipped is not None and isinstance(shipped.codec, TokenizerCodec)
    codec = shipped.codec
    scene = interpolate(codec.tokenizer.background[None], size, mode="bilinear", antialias=True)
    frames = (scene * 255).round().to(torch.uint8).permute(0, 2, 3, 1).view(1, 1, *size, 3)
    frames[..., 16:48, 16:48, :] = torch.tensor([200, 40, 40], dtype=torch.uint8)
    weights = {name: value.clone() for name, value in codec.state_dict().items()}
    latents = codec.encode(frames)
    assert latents.shape == (1, codec.channels, 1, size[0] // codec.patch, size[1] // codec.patch)
    error = (codec.decode(latents).float() - frames.float()).abs().mean()
    missed = (codec.decode(codec.encode(frames.flip(3))).float() - frames.float()).abs().mean()
    assert error < 12 and error < 0.5 * missed
    assert all(torch.equal(value, weights[name]) for name, value in codec.state_dict().items())


def test_an_indivisible_picture_wrong_channels_and_discrete_tokens_are_refused(world_model: Path) -> None:
    codec = codec_of_world_model(world_model)
    with pytest.raises(ValueError, match="image 40x128 px is not a multiple"):
        codec.encode(clips(height=40))
    with pytest.raises(ValueError, match="images must be uint8"):
        codec.encode(clips().float())
    with pytest.raises(ValueError, match="this codec has"):
        codec.decode(torch.zeros(1, codec.channels + 1, 3, *codec.tokenizer.grid))
    discrete = load_config("smoke", {"tokenizer.kind": "lfq"}).tokenizer
    with pytest.raises(ValueError, match=r"world model of tokenizer\.kind continuous, not lfq"):
        TokenizerCodec(discrete, 64, 128)
