"""A video model on disk: codec.safetensors, network.safetensors, and a manifest that says how they were made.

A folder inside a world model's folder whose codec is that model's tokenizer may leave codec.safetensors out.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from wm_nodes.config.schema import TokenizerConfig
from wm_nodes.core.device import device_of
from wm_nodes.core.model_folder import (
    MANIFEST,
    ModelFolderError,
    files_sha256,
    read_manifest,
    read_model_file,
    write_model_folder,
)
from wm_nodes.training.weights import WeightsError, load_weights, pack_weights
from wm_nodes.video_model import NetworkSettings, VideoNetwork
from wm_nodes.video_model.continuation import ClipLengths
from wm_nodes.video_model.tokenizer_codec import TokenizerCodec, codec_of_world_model

CODEC, NETWORK = "codec.safetensors", "network.safetensors"
FORMAT = 2


@dataclass(frozen=True)
class VideoFolder:
    """A video model, with what its folder says of it."""

    codec: TokenizerCodec
    """Pictures to latents and back."""
    network: VideoNetwork
    """In evaluation mode."""
    clip: Mapping[str, int]
    """How episodes are cut: stride (recorded steps between frames) and num_conditioning (given frames); of a model that
    goes on from its own frames also given_frames and new_frames, at most."""
    manifest: Mapping[str, Any]
    """How they were made."""

    @property
    def lengths(self) -> ClipLengths | None:
        """What a clip goes on from and how much it makes; None where a clip is a whole episode."""
        given = self.clip.get("given_frames", 0)
        return ClipLengths(given, self.clip["new_frames"]) if given else None

    @property
    def device(self) -> torch.device:
        return device_of(self.network)

    @property
    def sha256(self) -> str:
        return files_sha256(self.manifest)


def save_video_folder(
    folder: Path, codec: TokenizerCodec, network: VideoNetwork, clip: Mapping[str, int], story: Mapping[str, Any]
) -> Path:
    """Write the folder; the manifest, which names the files' sha256, comes last."""
    packed = {CODEC: pack_weights(codec), NETWORK: pack_weights(network)}
    manifest = {
        "format": FORMAT, "codec": codec.settings(),
        "network": asdict(network.settings), "clip": dict(clip),
        "sha256": {name: weights.sha256 for name, weights in packed.items()}, **story,
    }
    return write_model_folder(folder, {name: weights.data for name, weights in packed.items()}, manifest)


def read_video_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest alone. Raises ModelFolderError as load_video_folder."""
    return read_manifest(folder, "video model", FORMAT)


def load_video_folder(folder: Path, device: torch.device | str = "cpu") -> VideoFolder:
    """Load and verify a folder, onto `device`, in evaluation mode.

    Raises:
        ModelFolderError: names the file, what is wrong, and the remedy.
    """
    manifest = read_video_manifest(folder)
    network = VideoNetwork(NetworkSettings(**manifest["network"]))
    load_module(Path(folder) / NETWORK, network, manifest["sha256"][NETWORK])
    codec = _load_codec(Path(folder), manifest["sha256"][CODEC], **manifest["codec"])
    return VideoFolder(codec.to(device), network.to(device), manifest["clip"], manifest)


def _load_codec(folder: Path, sha256: str, kind: str, **settings: Any) -> TokenizerCodec:
    if kind != "tokenizer":
        raise ModelFolderError(f"{folder} has a codec of kind {kind}, this version reads tokenizer; train it anew")
    if not (folder / CODEC).is_file() and (folder.parent / MANIFEST).is_file():
        shared = codec_of_world_model(folder.parent)
        if pack_weights(shared).sha256 != sha256:
            raise ModelFolderError(f"{folder} was made with another tokenizer than {folder.parent}'s; train it anew")
        return shared
    codec = TokenizerCodec(**settings | {"config": TokenizerConfig.model_validate(settings["config"])})
    load_module(folder / CODEC, codec, sha256)
    return codec


def load_module(path: Path, module: nn.Module, sha256: str) -> None:
    """Load and verify the weights of a part, in evaluation mode. Raises ModelFolderError."""
    try:
        load_weights(module, read_model_file(path, sha256))
    except WeightsError as error:
        raise ModelFolderError(f"{path}: {error}") from None
    module.eval()
