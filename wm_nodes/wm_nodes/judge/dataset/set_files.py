"""The files of an adversarial set: manifest.jsonl and one compressed .npz per clip (frames, masks, fps)."""

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.types import media_sha
from wm_nodes.judge.dataset.edits.clips import LabelledClip
from wm_nodes.judge.dataset.edits.manifest import Manifest, ManifestError, from_bytes

MANIFEST = "manifest.jsonl"


def clip_path(folder: Path, sha256: str) -> Path:
    return folder / "clips" / f"{sha256}.npz"


def to_file(clip: LabelledClip) -> bytes:
    """The bytes of a clip's .npz."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, frames=clip.clip.frames, masks=clip.clip.masks, fps=np.float64(clip.clip.fps))
    return buffer.getvalue()


def load_array(folder: Path, sha256: str, name: str) -> NDArray[Any]:
    """One array of a clip: "frames", "masks" or "fps". Raises ManifestError: the file is missing or damaged."""
    path = clip_path(folder, sha256)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            array: NDArray[Any] = arrays[name]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ManifestError(f"{path} cannot be read: {error}; build the set again") from error
    return array


def load_frames(folder: Path, sha256: str) -> UInt8Array:
    """The frames of a clip, uint8 (T, H, W, 3). Raises ManifestError: missing, damaged, or those of another clip."""
    frames: UInt8Array = load_array(folder, sha256, "frames")
    if media_sha(frames, float(load_array(folder, sha256, "fps"))) != sha256:
        raise ManifestError(f"{clip_path(folder, sha256)} holds another clip than its name says; build the set again")
    return frames


def load_set(folder: Path) -> Manifest:
    """Read and verify a set's manifest. Raises ManifestError: see manifest.from_bytes. OSError: not there."""
    return from_bytes((folder / MANIFEST).read_bytes())


def check_set(folder: Path) -> Manifest:
    """Read the manifest and every clip of a set. Raises ManifestError: what is wrong. OSError: no manifest."""
    manifest = load_set(folder)
    for row in manifest.rows:
        load_frames(folder, row.sha256)
    return manifest
