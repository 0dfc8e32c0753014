"""The optional packages of the public models, imported where they are first needed."""

import importlib
from typing import Any

INSTALL = "pip install -c requirements/constraints.txt -r requirements/video.txt"


class MissingPackageError(ImportError):
    """A package of requirements/video.txt is not installed."""


def package(name: str) -> Any:
    """Return the imported module.

    Raises:
        MissingPackageError: it, or something it needs, is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"public video models need the package {error.name or name}, which is not installed; run: {INSTALL}"
        ) from error
