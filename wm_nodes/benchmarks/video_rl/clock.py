"""Seconds spent in named functions of a module, or methods of an object."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from wm_nodes.core.device import CPU_DEVICE, synchronize


@contextmanager
def clocked(owner: object, *names: str, device: torch.device = CPU_DEVICE) -> Iterator[list[float]]:
    """Yield [seconds spent so far in functions of `owner`], which are wrapped meanwhile.

    device: what they tell it to do is waited for.
    """
    spent, originals = [0.0], {name: getattr(owner, name) for name in names}

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            synchronize(device)
            start = time.perf_counter()
            result = function(*arguments)
            synchronize(device)
            spent[0] += time.perf_counter() - start
            return result

        return call

    for name, function in originals.items():
        setattr(owner, name, timed(function))
    try:
        yield spent
    finally:
        for name, function in originals.items():
            setattr(owner, name, function)
