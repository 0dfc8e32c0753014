"""A video model on disk: codec.safetensors, network.safetensors, and a manifest that says how they were made."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import nn

from wm_nodes.learning.files import write_atomic
from wm_nodes.learning.weights import WeightsError, load_weights, pack_weights
from wm_nodes.video_model import NetworkSettings, VideoNetwork
from wm_nodes.video_model.codec import PatchCodec

MANIFEST, CODEC, NETWORK = "manifest.json", "codec.safetensors", "network.safetensors"
FORMAT = 1


@dataclass(frozen=True)
class VideoFolder:
    """clip: how episodes are cut, {"stride": recorded steps between frames, "num_conditioning": given frames}."""

    codec: PatchCodec
    network: VideoNetwork
    clip: Mapping[str, int]
    manifest: Mapping[str, Any]


def save_video_folder(
    folder: Path, codec: PatchCodec, network: VideoNetwork, clip: Mapping[str, int], story: Mapping[str, Any]
) -> Path:
    """Write the folder; the manifest, which names the files' sha256, comes last."""
    hashes = {}
    for name, module in ((CODEC, codec), (NETWORK, network)):
        packed = pack_weights(module)
        write_atomic(folder / name, packed.data)
        hashes[name] = packed.sha256
    manifest = {
        "format": FORMAT, "codec": {"patch": codec.patch, "channels": codec.channels},
        "network": asdict(network.settings), "clip": dict(clip), "sha256": hashes, **story,
    }  # fmt: skip
    write_atomic(folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())
    return folder


def load_video_folder(folder: Path) -> VideoFolder:
    """Load and verify a folder, in evaluation mode.

    Raises:
        WeightsError: names the file, what is wrong, and the remedy.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise WeightsError(f"{folder} holds no {MANIFEST}; name the folder of a trained video model")
    manifest: dict[str, Any] = json.loads(path.read_text())
    if manifest.get("format") != FORMAT:
        raise WeightsError(f"{path}: format {manifest.get('format')!r}, this version reads {FORMAT}; train it anew")
    codec = PatchCodec(**manifest["codec"])
    network = VideoNetwork(NetworkSettings(**manifest["network"]))
    for name, module in ((CODEC, codec), (NETWORK, network)):
        _load(Path(folder) / name, module, manifest["sha256"][name])
    return VideoFolder(codec, network, manifest["clip"], manifest)


def _load(path: Path, module: nn.Module, sha256: str) -> None:
    if not path.is_file():
        raise WeightsError(f"{path} is missing; copy the whole model folder")
    load_weights(module, path.read_bytes(), sha256=sha256)
    module.eval()
