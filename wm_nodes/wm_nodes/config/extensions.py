"""Files that extend the product: one per task or shape, found by the name of their package. Standard library only."""

from __future__ import annotations

import importlib
import os
import pkgutil


def find_files(what: str, package: str, variable: str) -> dict[str, str]:
    """Package by file name, of our package and of those that an environment variable names, separated by commas.

    Args:
        what: a file defines, for errors.

    Raises:
        ValueError: a package is missing, or two have the same file.
    """
    packages: dict[str, str] = {}
    for name in (package, *filter(None, (part.strip() for part in os.environ.get(variable, "").split(",")))):
        try:
            folders = importlib.import_module(name).__path__
        except (ModuleNotFoundError, AttributeError) as error:
            raise ValueError(f"{variable} names {name!r}, no package that Python finds; see PYTHONPATH") from error
        for module in pkgutil.iter_modules(folders):
            if module.name.startswith("_"):
                continue
            if module.name in packages:
                raise ValueError(f"{what} {module.name!r} is in {packages[module.name]} and in {name}; rename one")
            packages[module.name] = name
    return packages
