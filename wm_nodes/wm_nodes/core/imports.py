"""What is imported by its name: a callable that the settings name, and packages that only a part of the project needs,
imported where they are first used."""

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


def load_factory(path: str) -> Any:
    """Return the callable behind "module:callable".

    Raises:
        ValueError: wrong form, no such module or no such name in it.
    """
    module_name, separator, name = path.partition(":")
    if not separator or not module_name or not name:
        raise ValueError(f"a factory is written module:callable, got {path!r}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ValueError(f"factory {path!r}: {error}; put its folder on PYTHONPATH") from None
    if not callable(getattr(module, name, None)):
        raise ValueError(f"factory {path!r}: module {module_name} has no callable {name!r}")
    return getattr(module, name)
