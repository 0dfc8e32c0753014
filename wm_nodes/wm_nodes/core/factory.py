"""A callable of somebody else's, named in the settings: "module:callable"."""

import importlib
from typing import Any


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
