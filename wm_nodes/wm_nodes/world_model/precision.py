"""Which floating-point type the models compute in on a device."""

from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from functools import cache
from typing import Any, TypeVar

import torch
from torch import nn

_Model = TypeVar("_Model", bound=nn.Module)


@cache
def cpu_has_fast_bfloat16() -> bool:
    """True where the processor multiplies bfloat16 in hardware (avx512_bf16 or AMX), at about twice the speed."""
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def has_fast_bfloat16(device: torch.device) -> bool:
    return torch.cuda.is_bf16_supported() if device.type == "cuda" else cpu_has_fast_bfloat16()


def compute_context(device: torch.device, *, exact: bool = False) -> AbstractContextManager[Any]:
    """Autocast to bfloat16 where the device is fast at it; float32 everywhere else, and always if `exact`."""
    if exact or not has_fast_bfloat16(device):
        return nullcontext()
    return torch.autocast(device.type, dtype=torch.bfloat16)


def copy_in_bfloat16(model: _Model) -> _Model:
    """A copy whose products have their weights in bfloat16; the rest stays float32.

    Under autocast it computes what the model does, bit for bit, without casting the same weights at every call, which
    autocast does to weights without gradients.
    """
    copied = deepcopy(model)
    for module in copied.modules():
        if isinstance(module, (nn.Linear, nn.Conv2d)):
            module.to(torch.bfloat16)
    return copied
