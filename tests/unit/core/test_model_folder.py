"""The part that all model folders share: manifest, sha256, and refusals of one line."""

import hashlib
import re
from pathlib import Path

import pytest

from wm_nodes.core.model_folder import ModelFolderError, read_manifest, read_model_file, write_model_folder

DATA = b"weights"
SHA256 = hashlib.sha256(DATA).hexdigest()


def make_folder(folder: Path) -> Path:
    return write_model_folder(folder, {"a.safetensors": DATA}, {"format": 1, "sha256": {"a": SHA256}})


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "model")
    manifest = read_manifest(folder, "world model", 1)
    assert manifest == {"format": 1, "sha256": {"a": SHA256}}
    assert read_model_file(folder / "a.safetensors", manifest["sha256"]["a"]) == DATA


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "holds no manifest.json; name the folder of a trained world model"),
        ("{", "manifest.json cannot be read"),
        ("[]", "manifest.json holds no JSON object"),
        ('{"format": 2}', "manifest.json has format 2, this version reads 1; train it anew"),
    ],
)
def test_a_manifest_that_cannot_be_used_is_one_line_with_a_remedy(
    tmp_path: Path, content: str | None, message: str
) -> None:
    if content is not None:
        (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(ModelFolderError, match=re.escape(message)) as caught:
        read_manifest(tmp_path, "world model", 1)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_a_file_that_is_missing_or_another_one_is_refused(tmp_path: Path) -> None:
    path = make_folder(tmp_path / "model") / "a.safetensors"
    path.write_bytes(DATA[:-1])
    with pytest.raises(ModelFolderError, match=r"a\.safetensors is not the file its manifest names \(sha256 differs\)"):
        read_model_file(path, SHA256)
    path.unlink()
    with pytest.raises(ModelFolderError, match=r"a\.safetensors is missing; copy the whole model folder"):
        read_model_file(path, SHA256)
