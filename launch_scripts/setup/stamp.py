"""What the virtual environment already holds: one fingerprint per step, so that only what changed is done again; and
what was begun, so that a start after an interrupted one knows what to repair."""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Iterable
from pathlib import Path

BEGUN = "begun"
"""In place of a fingerprint: what the step makes cannot be trusted."""


def fingerprint(files: Iterable[Path], *extra: str) -> str:
    """Return a sha256 over names and contents of files, and `extra`."""
    digest = hashlib.sha256(platform.machine().encode())
    for text in extra:
        digest.update(b"\0" + text.encode())
    for file in sorted(files):
        digest.update(b"\0" + file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def python_version(venv: Path) -> str:
    """Version of the Python in a virtual environment; of the running one where there is none yet."""
    try:
        lines = (venv / "pyvenv.cfg").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.python_version()
    values = {key.strip(): value.strip() for key, _, value in (line.partition("=") for line in lines)}
    return values.get("version", platform.python_version())


def stamp_file(venv: Path) -> Path:
    return venv / "wm_setup_stamp.json"


def begin(venv: Path, part: str) -> bool:
    """Note that `part` begins; return True where it was begun before and has not been finished."""
    stamp = read_stamp(stamp_file(venv))
    write_stamp(stamp_file(venv), {**stamp, part: BEGUN})
    return stamp.get(part) == BEGUN


def finish(venv: Path, done: dict[str, str]) -> None:
    """Note what has been finished: part -> fingerprint, or any other word."""
    write_stamp(stamp_file(venv), {**read_stamp(stamp_file(venv)), **done})


def read_stamp(path: Path) -> dict[str, str]:
    """Return step -> fingerprint; empty where there is no readable stamp."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {str(k): str(v) for k, v in values.items()} if isinstance(values, dict) else {}


def write_stamp(path: Path, stamp: dict[str, str]) -> None:
    """Replace the stamp in one go, so that an interrupted set-up leaves the old one."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps({**stamp, "python": sys.executable}, indent=1, sort_keys=True), encoding="utf-8")
    temporary.replace(path)
