"""Weights as safetensors bytes: named, hashed, checked against the architecture before they are used. No pickle."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from wm_nodes.core.files import write_atomic
from wm_nodes.training.checkpoint import metadata_of

INLINE_LIMIT_BYTES = 1 << 20
"""Weights up to this size travel inside PolicyVersion.inline_data."""

_METADATA_KEY = "wm_nodes"


class WeightsError(ValueError):
    """Weights that are damaged, are not the expected ones, or belong to another architecture."""


@dataclass(frozen=True)
class PackedWeights:
    """The weights of a module as one file."""

    data: bytes
    """The safetensors file."""
    sha256: str
    """Of data."""
    arch_hash: str
    """See arch_hash()."""
    metadata: Mapping[str, str]
    """Texts inside the file, by name; arch_hash is one of them."""


def arch_hash(tensors: Mapping[str, Tensor]) -> str:
    """Return the sha256 over sorted names, shapes and dtypes of a state dictionary."""
    layout = [(name, *_shape_and_dtype(tensors[name])) for name in sorted(tensors)]
    return hashlib.sha256(json.dumps(layout).encode()).hexdigest()


def pack_weights(module: nn.Module, metadata: Mapping[str, str] | None = None) -> PackedWeights:
    """Return the module's parameters and buffers as bytes; equal weights and metadata give equal bytes."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in module.state_dict().items()}
    texts = {**(metadata or {}), "arch_hash": arch_hash(tensors)}
    data = save(tensors, {_METADATA_KEY: json.dumps(texts, sort_keys=True)})
    return PackedWeights(data, hashlib.sha256(data).hexdigest(), texts["arch_hash"], texts)


def unpack_weights(data: bytes, *, sha256: str | None = None) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return (tensors, metadata) after checking the sha256, where given, and the architecture hash.

    Raises:
        WeightsError: damaged or foreign data; says what was expected and found.
    """
    actual = hashlib.sha256(data).hexdigest()
    if sha256 is not None and actual != sha256:
        raise WeightsError(f"weights have sha256 {actual}, expected {sha256}; transfer or write them again")
    try:
        tensors, text = load(data), metadata_of(data).get(_METADATA_KEY)
    except (SafetensorError, ValueError) as error:
        raise WeightsError(f"weights are no safetensors file or are cut short ({len(data)} bytes): {error}") from None
    if text is None:
        raise WeightsError("weights carry no wm_nodes metadata; write them with training.weights.pack_weights")
    metadata: dict[str, str] = json.loads(text)
    if metadata.get("arch_hash") != arch_hash(tensors):
        raise WeightsError(f"weights say arch_hash {metadata.get('arch_hash')}, but hold {arch_hash(tensors)}")
    return tensors, metadata


def load_weights(module: nn.Module, data: bytes, *, sha256: str | None = None) -> dict[str, str]:
    """Copy weights into the module and return their metadata. The module is unchanged when an error is raised.

    Raises:
        WeightsError: damaged data, or another architecture (names the first difference).
    """
    tensors, metadata = unpack_weights(data, sha256=sha256)
    check_same_layout(module.state_dict(), tensors, what="weights")
    module.load_state_dict(tensors)
    return metadata


def load_weights_file(module: nn.Module, path: Path) -> dict[str, str]:
    """load_weights() of a file, which errors name. Raises OSError, too."""
    data = path.read_bytes()
    try:
        return load_weights(module, data)
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from None


def save_weights(module: nn.Module, path: Path, metadata: Mapping[str, str] | None = None) -> PackedWeights:
    """Write the weights to `path` atomically and return them."""
    packed = pack_weights(module, metadata)
    write_atomic(path, packed.data)
    return packed


def check_same_layout(expected: Mapping[str, Tensor], found: Mapping[str, Tensor], *, what: str) -> None:
    """Raise WeightsError that names the first parameter, in sorted order, that is missing, extra or of another kind."""
    for name in sorted(set(expected) | set(found)):
        if name not in found:
            problem = "is missing"
        elif name not in expected:
            problem = "is unknown"
        else:
            (shape, dtype), (other_shape, other_dtype) = (_shape_and_dtype(t[name]) for t in (expected, found))
            problem = f"is {other_dtype}{other_shape}, expected {dtype}{shape}"
            if (shape, dtype) == (other_shape, other_dtype):
                continue
        raise WeightsError(f"{what} of another architecture: {name} {problem}; use the configuration it was made by")


def _shape_and_dtype(tensor: Tensor) -> tuple[list[int], str]:
    return list(tensor.shape), str(tensor.dtype).removeprefix("torch.")
