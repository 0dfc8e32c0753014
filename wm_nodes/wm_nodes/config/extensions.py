"""Files that extend the product: one per task or shape, found by the name of their package. Standard library only."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
import sys
from pathlib import Path
from types import ModuleType
from typing import TypeVar

T = TypeVar("T")


ROOM = "wm_nodes.environments"
SUFFIX = ".py"
"""Of a file that is named by its path."""


def find_files(kind: str, folder: str, variable: str) -> dict[str, str]:
    """Package, or path, by file name: of our packages, and of those packages, modules and paths of .py files that an
    environment variable names, separated by commas.

    Args:
        kind: what a file defines, for errors.
        folder: name of our packages, each in a package of ROOM.

    Raises:
        ValueError: a package or file is missing, or two have the same file.
    """
    packages: dict[str, str] = {}
    named = filter(None, (part.strip() for part in os.environ.get(variable, "").split(",")))
    for name in (*_shipped(folder), *named):
        for parent, module in _modules(name, variable):
            if module in packages:
                raise ValueError(f"{kind} {module!r} is in {packages[module]} and in {parent}; rename one")
            packages[module] = parent
    return packages


def name_file(file: Path, variable: str) -> str:
    """Let an environment variable name a .py file too, here and in the processes that begin from now on; returns its
    name without .py."""
    named = [name for name in os.environ.get(variable, "").split(",") if name]
    os.environ[variable] = ",".join(dict.fromkeys([*named, str(file.absolute())]))
    return file.stem


def _modules(name: str, variable: str) -> list[tuple[str, str]]:
    """Package (or path) and name of each file that a package holds, or of the one that the name says; none is
    imported."""
    if name.endswith(SUFFIX):
        if not Path(name).is_file():
            raise ValueError(f"{variable} names {name!r}, which is no file")
        return [(name, Path(name).stem)]
    try:
        place = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        place = None
    if place is None:
        raise ValueError(f"{variable} names {name!r}, no package or module that Python finds; see PYTHONPATH")
    if place.submodule_search_locations is None:
        return [(name.rpartition(".")[0], name.rpartition(".")[2])]
    modules = pkgutil.iter_modules(place.submodule_search_locations)
    return [(name, module.name) for module in modules if not module.name.startswith("_")]


def load_file(name: str, packages: dict[str, str], kind: type[T], guide: str) -> T:
    """Import a file and return its constant, which is named as its class: TASK = Task(...).

    Args:
        packages: see find_files.
        guide: the module that says how to write one, for the error.

    Raises:
        ValueError: the file has no such constant.
    """
    module = _imported(name, packages[name])
    place = getattr(module, kind.__name__.upper(), None)
    if not isinstance(place, kind):
        raise ValueError(f"{module.__file__} has no {kind.__name__.upper()} = {kind.__name__}(...); see {guide}")
    return place


def _imported(name: str, place: str) -> ModuleType:
    """The module `name` of a package, or in the file at a path."""
    if not place.endswith(SUFFIX):
        return importlib.import_module(".".join(filter(None, (place, name))))
    spec = importlib.util.spec_from_file_location(f"file_of_{name}", place)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _shipped(folder: str) -> list[str]:
    parts = pkgutil.iter_modules(importlib.import_module(ROOM).__path__)
    names = [f"{ROOM}.{part.name}.{folder}" for part in parts if part.ispkg]
    return [name for name in names if importlib.util.find_spec(name)]
