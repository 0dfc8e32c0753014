"""One root seed, named streams: every random number of a run comes from (root seed, name, indices)."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


def stream_seed(root_seed: int, name: str, *indices: int) -> int:
    """Return a 63-bit seed for the stream `name` at `indices`, e.g. stream_seed(0, "action_noise", version, step)."""
    text = "/".join([str(root_seed), name, *map(str, indices)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def numpy_stream(root_seed: int, name: str, *indices: int) -> np.random.Generator:
    return np.random.default_rng(stream_seed(root_seed, name, *indices))


def torch_stream(root_seed: int, name: str, *indices: int) -> torch.Generator:
    """A CPU generator; draw on the CPU and move, so that results do not depend on the device."""
    return torch.Generator().manual_seed(stream_seed(root_seed, name, *indices))


@contextmanager
def initial_weights(root_seed: int, name: str) -> Iterator[None]:
    """Modules made inside draw their first weights from stream `name`; torch's global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(numpy_stream(root_seed, name).integers(2**31)))
        yield
