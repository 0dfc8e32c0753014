"""Model folders: files of weights, and a manifest that names the sha256 of each and is written last."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wm_nodes.core.files import write_atomic

MANIFEST = "manifest.json"
AGAIN = "delete it, and the same command makes it again"
"""A remedy for a damaged file."""


class ModelFolderError(ValueError):
    """A model folder that is missing, incomplete, damaged, or of another kind: names the path and the remedy."""


def write_model_folder(
    folder: Path, files: Mapping[str, bytes], manifest: Mapping[str, Any], manifest_name: str = MANIFEST
) -> Path:
    """Write the files, then the manifest, each atomically. Raises OSError."""
    for name, data in files.items():
        write_atomic(folder / name, data)
    write_atomic(folder / manifest_name, (json.dumps(manifest, indent=1) + "\n").encode())
    return folder


def read_manifest(folder: Path, kind: str, version: int | str, manifest_name: str = MANIFEST) -> dict[str, Any]:
    """Read a manifest.

    Args:
        kind: what the folder should hold, e.g. "world model".
        version: the value of `format` that can be read.

    Raises:
        ModelFolderError: there is no manifest, it is damaged, or it is of another version.
    """
    path = Path(folder) / manifest_name
    if not path.is_file():
        raise ModelFolderError(f"{folder} holds no {manifest_name}; name the folder of a trained {kind}")
    manifest = read_json(path, "copy the whole model folder again")
    if manifest.get("format") != version:
        raise ModelFolderError(
            f"{path} has format {manifest.get('format')!r}, this version reads {version!r}; train it anew"
        )
    return manifest


def files_sha256(manifest: Mapping[str, Any]) -> str:
    """Of a manifest's file hashes: the identity of the model."""
    return hashlib.sha256(json.dumps(manifest["sha256"], sort_keys=True).encode()).hexdigest()


def read_model_file(path: Path, sha256: str) -> bytes:
    """Read a file of a model folder. Raises ModelFolderError where it is not the one of the manifest's sha256."""
    if not path.is_file():
        raise ModelFolderError(f"{path} is missing; copy the whole model folder")
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != sha256:
        raise ModelFolderError(f"{path} is not the file its manifest names (sha256 differs); copy the folder again")
    return data


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """Read a JSON object. Raises ModelFolderError, which ends with the remedy."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ModelFolderError(f"{path} is missing; {remedy}") from None
    except (OSError, ValueError) as error:
        raise ModelFolderError(f"{path} cannot be read ({error}); {remedy}") from error
    if not isinstance(content, dict):
        raise ModelFolderError(f"{path} holds no JSON object; {remedy}")
    return content
