"""Inference on a batch in parts, a thread per core.

torch's own threads meet after every operation: one that another program holds up holds up all. Parts meet once. They
depend on the batch alone, so the numbers are those of any number of cores.
"""

import functools
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

PART = 32
"""Most rows of a part. Rows of much smaller ones cost more; a row alone is computed by other kernels, with other
rounding."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def parts_of(batch: int, device: torch.device) -> list[slice]:
    """The rows of each part, as equal as can be; one part of everything on any device but the CPU."""
    count = max(1, -(-batch // PART)) if device.type == "cpu" else 1
    ends = [batch * i // count for i in range(count + 1)]
    return [slice(start, end) for start, end in itertools.pairwise(ends)]


def in_parallel(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """Return the results of `function`, which is called without gradients, for all items, in their order; several items
    each in a thread with one torch thread. An exception of a call is raised."""
    infer = torch.inference_mode()(function)
    if len(items) < 2:
        return [infer(item) for item in items]
    return list(_pool(os.getpid()).map(infer, items))


def in_parts(function: Callable[[slice], Tensor], batch: int, device: torch.device) -> Tensor:
    """The results of `function` for the rows of each part, one below the other."""
    results = in_parallel(function, parts_of(batch, device))
    return results[0] if len(results) == 1 else torch.cat(results)


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The threads of one process: those of a parent do not live on in its fork."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)), f"part_{process}", torch.set_num_threads, (1,))
