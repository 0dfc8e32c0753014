"""Which floating-point type the models compute in on a device."""

import sys
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from functools import cache
from typing import Any, TypeVar

import torch
from torch import nn

from wm_nodes.core.device import device_label

_Model = TypeVar("_Model", bound=nn.Module)


@cache
def cpu_has_fast_bfloat16() -> bool:
    """True where the processor multiplies bfloat16 in hardware (avx512_bf16 or AMX), at about twice the speed."""
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


@cache
def _gpu_has_bfloat16(device: torch.device) -> bool:
    """True where the GPU multiplies bfloat16 in hardware; says once where it does not, and what follows."""
    fast = bool(torch.cuda.is_bf16_supported(including_emulation=False))
    if not fast:
        print(f"warning: {device_label(device)} has no bfloat16; models compute in float32 there", file=sys.stderr)
    return fast


def has_fast_bfloat16(device: torch.device) -> bool:
    return _gpu_has_bfloat16(device) if device.type == "cuda" else cpu_has_fast_bfloat16()


def compute_context(device: torch.device, *, exact: bool = False) -> AbstractContextManager[Any]:
    """Autocast to bfloat16 where the device is fast at it; float32 everywhere else, and always if `exact`."""
    if exact or not has_fast_bfloat16(device):
        return nullcontext()
    return torch.autocast(device.type, dtype=torch.bfloat16)


def copy_in_bfloat16(model: _Model) -> _Model:
    """A copy whose products have their weights in bfloat16; the rest, and parts that are `exact`, stay float32.

    Under autocast it computes what the model does, bit for bit, without casting the same weights at every call, which
    autocast does to weights without gradients.
    """
    copied = deepcopy(model)
    exact = {part for module in copied.modules() if getattr(module, "exact", False) for part in module.modules()}
    for module in copied.modules():
        if isinstance(module, (nn.Linear, nn.Conv2d)) and module not in exact:
            module.to(torch.bfloat16)
    return copied
