"""Packages that only a part of the project needs, imported where they are first used."""

import importlib
from typing import Any


class MissingPackageError(ImportError):
    """An optional package is not installed; says how to install it."""


def optional_package(name: str, *, needed_by: str, requirements: str) -> Any:
    """Return the imported module.

    Args:
        needed_by: subject and verb of the error, e.g. "public video models need". requirements: file in requirements/.

    Raises:
        MissingPackageError: it, or something it needs, is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"{needed_by} the package {error.name or name}, which is not installed; run: "
            f"pip install -c requirements/lock.txt -r requirements/{requirements}"
        ) from error
