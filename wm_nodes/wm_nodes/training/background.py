"""Batches that are read in a thread and brought to the device while it computes on the one before."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor


class BackgroundBatches:
    """Batches by the number of their iteration, on `device`.

    For a GPU they are read one iteration ahead, in a thread, and copied without a wait; for the CPU, whose cores the
    thread would take, when they are asked for. They are the same either way.

    Args:
        read: iteration -> tensors on the CPU; depends on nothing else.
    """

    def __init__(self, read: Callable[[int], tuple[Tensor, ...]], device: torch.device) -> None:
        self._read, self._device = read, device
        self._thread = ThreadPoolExecutor(1, "batches") if device.type == "cuda" else None
        self._ahead: tuple[int, Future[tuple[Tensor, ...]]] | None = None

    def __call__(self, iteration: int) -> tuple[Tensor, ...]:
        """Return the batch of this iteration. Raises what `read` raises."""
        if self._thread is None:
            return self._read(iteration)
        number, future = self._ahead or (-1, None)
        self._ahead = iteration + 1, self._thread.submit(self._read, iteration + 1)
        tensors = future.result() if future is not None and number == iteration else self._read(iteration)
        return tuple(tensor.pin_memory().to(self._device, non_blocking=True) for tensor in tensors)
