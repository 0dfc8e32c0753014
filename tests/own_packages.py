"""A user's own package of tasks or shapes, as files in a temporary folder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def write_package(folder: Path, name: str, **files: str) -> None:
    """files: module -> source."""
    (folder / name).mkdir()
    for module, text in {"__init__": "", **files}.items():
        (folder / name / f"{module}.py").write_text(text, encoding="utf-8")


@contextmanager
def own_package(folder: Path, name: str, variable: str, **files: str) -> Iterator[None]:
    """Within it, the package of these modules can be imported and is what the environment variable names."""
    write_package(folder, name, **files)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.setenv(variable, name)
        yield
