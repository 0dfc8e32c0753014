"""The setting `device` of both loops, and what a missing, small or old GPU is reported as.

Nothing here runs when a module is imported: a process that forks must not have started CUDA.
"""

import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import nn

AUTO, CPU, CUDA = "auto", "cpu", "cuda"
CPU_DEVICE = torch.device(CPU)


class DeviceError(ValueError):
    """A device that this machine or this torch does not have, or whose memory is too small."""


def compute_device(name: str) -> torch.device:
    """Return the device called `name`: cpu, cuda, cuda:N, or auto (a GPU where there is one, else the CPU).

    On a GPU, float32 convolutions are float32 from then on (torch's default, TF32, keeps 10 bits of their fractions),
    and cuDNN takes algorithms that give the same bits twice, so that a resumed run goes on as the first did.

    Raises:
        DeviceError: there is no such device; says what to do.
    """
    if name == CPU or (name == AUTO and not torch.cuda.is_available()):
        return CPU_DEVICE
    if not torch.cuda.is_available():
        raise DeviceError(
            f"device is {name}, but torch {torch.__version__} sees no GPU; set device to cpu or auto, or install a "
            "CUDA build of torch"
        )
    device = torch.device(CUDA, 0) if name in (AUTO, CUDA) else torch.device(name)
    count = torch.cuda.device_count()
    if (device.index or 0) >= count:
        raise DeviceError(f"device is {name}, but the GPUs here are cuda:0 to cuda:{count - 1}; name one of them")
    torch.backends.cudnn.allow_tf32, torch.backends.cudnn.deterministic = False, True
    return device


def device_of(module: nn.Module) -> torch.device:
    """Return where a module's first parameter, or else its first buffer, is."""
    return next(itertools.chain(module.parameters(), module.buffers())).device


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has done what it was told, so that a clock read next counts it; nothing on the CPU."""
    if device.type == CUDA:
        torch.cuda.synchronize(device)


def device_label(device: torch.device) -> str:
    """Return what a report calls a device: cpu, or a GPU's index and name."""
    return str(device) if device.type == CPU else f"{device} ({torch.cuda.get_device_name(device)})"


@contextmanager
def explain_memory(device: torch.device | str, **settings: int) -> Iterator[None]:
    """Turn a GPU's out-of-memory error into one line that names the settings to lower and halves them.

    Args:
        settings: what the work's memory grows with, by dotted names with "__" for ".".

    Raises:
        DeviceError: the GPU's memory was too small.
    """
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        raise DeviceError(_too_small(str(device), settings)) from None


def _too_small(device: str, settings: Mapping[str, int]) -> str:
    named = {name.replace("__", "."): value for name, value in settings.items()}
    half = ", ".join(f"{name} from {value} to {max(1, value // 2)}" for name, value in named.items())
    return f"the memory of {device} is too small; lower {half or 'the batch'}, or take a smaller preset"
