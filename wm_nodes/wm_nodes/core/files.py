"""Atomic writing, hashing and lines of files."""

import hashlib
import os
import threading
from pathlib import Path
from typing import TextIO


def write_atomic(path: Path, data: bytes, *, flush: bool = True) -> None:
    """Write to a temporary name beside `path`, flush to disk, rename.

    flush: False leaves the flush to the system, for small files that can be made again.

    Raises:
        OSError: e.g. a full disk; the temporary file is removed and an older file at `path` stays as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            if flush:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        text = f"cannot write {path}: {error.strerror}; free some space there, or take another folder"
        raise OSError(error.errno, text) from error
    if not flush:
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def text_lines(data: bytes) -> list[str]:
    """The lines of a text in UTF-8. A newline alone ends one: str.splitlines also cuts at U+2028, U+2029 and U+0085,
    which a JSON string may hold. A byte-order mark at the start is left out. Raises UnicodeDecodeError.
    """
    *lines, last = data.decode("utf-8-sig").split("\n")
    return [*lines, last] if last else lines


def open_to_append(path: Path) -> TextIO:
    """Open a file of lines to write more of them; one that was cut, as by a full disk, is ended first, as the next line
    would be lost with it. Raises OSError."""
    with open(path, "ab+") as file:
        if file.tell():
            file.seek(-1, os.SEEK_END)
            file.write(b"" if file.read(1) == b"\n" else b"\n")
    return open(path, "a", encoding="utf-8")


def file_sha256(path: Path) -> str:
    """Return the sha256 of the file's bytes. Raises OSError."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
