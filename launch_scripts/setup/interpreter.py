"""Which Python: 3.11 or 3.12, for which the ROS 2 wheels exist."""

from __future__ import annotations

import glob
import os
import shutil
import sys

from setup.console import output_of

SUPPORTED = ((3, 11), (3, 12))


def supported(version: tuple[int, ...]) -> bool:
    return tuple(version[:2]) in SUPPORTED


def find_supported(search_path: str | None = None, pyenv_root: str | None = None) -> str | None:
    """Return a working Python 3.12 or 3.11: on PATH, or among pyenv's versions; None where there is none."""
    names = [f"python{major}.{minor}" for major, minor in SUPPORTED]
    candidates = [path for name in names if (path := shutil.which(name, path=search_path))]
    root = pyenv_root or os.environ.get("PYENV_ROOT") or os.path.expanduser("~/.pyenv")
    for name in names:
        candidates += sorted(glob.glob(os.path.join(root, "versions", "*", "bin", name)), reverse=True)
    return next((path for path in candidates if _works(path)), None)


def unsupported_message(version: tuple[int, ...]) -> str:
    found = ".".join(map(str, version[:3]))
    return (
        f"Python 3.11 or 3.12 is needed (the ROS 2 Jazzy wheels exist for these two), but this is {found} "
        f"({sys.executable}), and neither python3.11 nor python3.12 is on PATH or in ~/.pyenv/versions.\n"
        "  Debian 12 and Ubuntu 24.04 have a right one: apt-get install python3 python3-venv\n"
        "  elsewhere, for example: pyenv install 3.12 && python3.12 launch_scripts/setup"
    )


def _works(path: str) -> bool:
    """A pyenv shim exists on PATH even where its version is not selected: ask the interpreter itself."""
    return supported(tuple(map(int, output_of([path, "-c", "import sys; print(*sys.version_info[:2])"]).split())))
