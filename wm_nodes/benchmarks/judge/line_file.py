"""Records that a killed run keeps: one JSON line each."""

import os
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import TypeAdapter, ValidationError

T = TypeVar("T")


class LineFile(Generic[T]):
    """Dataclasses of one kind by their field `key`; the last line of a key counts, a torn line is passed over."""

    def __init__(self, path: Path, kind: type[T], key: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._key, self._adapter = path, key, TypeAdapter(kind)
        self.rows: dict[str, T] = {}
        for line in path.read_bytes().splitlines() if path.is_file() else ():
            try:
                row = self._adapter.validate_json(line)
            except ValidationError:
                continue
            self.rows[getattr(row, key)] = row

    def add(self, row: T) -> None:
        """Append the record and flush it to disk."""
        self.rows[getattr(row, self._key)] = row
        with self._path.open("ab") as file:
            if file.tell() and not self._path.read_bytes().endswith(b"\n"):
                file.write(b"\n")
            file.write(self._adapter.dump_json(row) + b"\n")
            file.flush()
            os.fsync(file.fileno())
