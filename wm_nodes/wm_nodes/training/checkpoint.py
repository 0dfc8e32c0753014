"""Optimiser states and named parts in one safetensors file, and back: what every checkpoint here is made of."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from wm_nodes.core.files import write_atomic

RESTORE = "put a copy of it back, or begin anew in another run folder"


class DamagedFileError(ValueError):
    """A file that is cut short or holds something else; names it and the remedy."""


def write_checkpoint(path: Path, sections: Mapping[str, Mapping[str, Tensor]], metadata: Mapping[str, str]) -> None:
    """Write tensors as "<section>.<name>" and the metadata, atomically. Raises OSError."""
    tensors = {
        f"{prefix}.{name}": tensor.detach().to("cpu", copy=True).contiguous()
        for prefix, named in sections.items() for name, tensor in named.items()
    }
    write_atomic(path, save(tensors, dict(metadata)))


def read_checkpoint(path: Path, remedy: str = RESTORE) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return (tensors, metadata) of write_checkpoint(). Raises OSError, or DamagedFileError, which ends with remedy."""
    data = path.read_bytes()
    try:
        return load(data), metadata_of(data)
    except (SafetensorError, ValueError) as error:
        raise _damaged(path, error, remedy) from None


def read_tensors(path: Path, remedy: str) -> dict[str, Tensor]:
    """The tensors of a safetensors file. Raises as read_checkpoint()."""
    return read_checkpoint(path, remedy)[0]


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The optimiser's state by "<parameter number>.<name>"; not copied."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{name}": value for index, entries in state.items() for name, value in entries.items()}


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Put a state of optimizer_tensors() back; learning rates and the like stay the optimiser's own."""
    state: dict[int, dict[str, Any]] = {}
    for key, tensor in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = tensor.clone()
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def section(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def metadata_of(data: bytes) -> dict[str, str]:
    """The metadata of a safetensors file."""
    header: dict[str, Any] = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    texts: dict[str, str] = header.get("__metadata__", {})
    return texts


def read_metadata(path: Path) -> dict[str, str]:
    """The metadata of a safetensors file, without reading its tensors. Raises as read_checkpoint()."""
    with open(path, "rb") as file:
        size = file.read(8)
        try:
            return metadata_of(size + file.read(int.from_bytes(size, "little")))
        except (ValueError, OverflowError, MemoryError) as error:
            raise _damaged(path, error, RESTORE) from None


def _damaged(path: Path, error: Exception, remedy: str) -> DamagedFileError:
    size = path.stat().st_size
    return DamagedFileError(f"{path} is damaged or cut short, no safetensors file ({size} bytes: {error}); {remedy}")
