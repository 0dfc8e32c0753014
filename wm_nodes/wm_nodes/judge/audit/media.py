"""Pictures and arrays beside an audit log, each stored once under the SHA-256 of its file. Shapes: T frames, H W 3."""

import hashlib
import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.files import write_atomic
from wm_nodes.judge.audit.log import AuditError

FOLDER = "media"


class MediaStore:
    """uint8 RGB images as PNG, lossless; anything else as .npy. A name is `<SHA-256 of the file>.<png or npy>`."""

    def __init__(self, log_folder: Path) -> None:
        self._folder = Path(log_folder) / FOLDER

    def put(self, array: NDArray[Any]) -> str:
        """Store an array, unless it is there; return its name. Raises AuditError: Python objects. OSError: disk."""
        data, suffix = _encode(np.asarray(array))
        name = f"{hashlib.sha256(data).hexdigest()}.{suffix}"
        path = self.path(name)
        if path.is_file() and path.stat().st_size == len(data):
            return name
        write_atomic(path, data, flush=False)
        return name

    def get(self, name: str) -> NDArray[Any]:
        """The array. Raises AuditError: missing, or not what was stored."""
        data = self._read_checked(name)
        if name.endswith(".npy"):
            array: NDArray[Any] = np.load(io.BytesIO(data), allow_pickle=False)
            return array
        return np.ascontiguousarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])

    def path(self, name: str) -> Path:
        """Where a file is. Raises AuditError: not the plain name of a stored file; names come from a log."""
        stem, _, suffix = name.partition(".")
        if len(stem) != 64 or not set(stem) <= set("0123456789abcdef") or suffix not in ("png", "npy"):
            raise AuditError(f"{name!r} is no name of a stored picture")
        return self._folder / stem[:2] / name

    def _read_checked(self, name: str) -> bytes:
        path = self.path(name)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise AuditError(f"{path} cannot be read: {error.strerror}") from None
        if hashlib.sha256(data).hexdigest() != name.partition(".")[0]:
            raise AuditError(f"{path} was changed after it was stored")
        return data


def _encode(array: NDArray[Any]) -> tuple[bytes, str]:
    if array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3 and array.size:
        return cv2.imencode(".png", np.ascontiguousarray(array[..., ::-1]))[1].tobytes(), "png"
    if array.dtype.hasobject:
        raise AuditError(f"an array of {array.dtype} cannot be stored; give numbers")
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue(), "npy"
