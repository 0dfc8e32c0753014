"""Several learner processes under torchrun: every rank holds the whole rollout and a share of each minibatch; gradients
are summed, so R ranks make the update of one.

Host memory (rollouts, flags, sums) goes by gloo; where the learner computes on GPUs, one for each rank, gradients go by
nccl.
"""

import json
import os
from dataclasses import fields
from datetime import timedelta
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from wm_nodes.core.device import CPU, CUDA, compute_device
from wm_nodes.core.types import Rollout

BACKENDS = {CPU: "gloo", CUDA: "cpu:gloo,cuda:nccl"}
"""By the type of the device that the learner computes on."""


class Ranks:
    """One process of `size`. With size 1 nothing is communicated and no process group is needed."""

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    def share(self, index: Tensor) -> Tensor:
        """This rank's part of a minibatch's sample numbers; together the parts are the minibatch."""
        return index[self.rank :: self.size]

    def sum_(self, *tensors: Tensor) -> None:
        """Replace each tensor by its sum over the ranks."""
        if self.size > 1:
            for tensor in tensors:
                dist.all_reduce(tensor)

    def sum_gradients(self, module: nn.Module) -> None:
        """Sum each parameter's gradient. A frozen one has none on any rank and keeps none: with a zero instead, Adam
        would count a step that a single process does not make."""
        gradients = [parameter.grad for parameter in module.parameters() if parameter.grad is not None]
        if self.size > 1 and gradients:
            flat = torch.cat([gradient.flatten() for gradient in gradients])
            dist.all_reduce(flat)
            parts = torch.split(flat, [gradient.numel() for gradient in gradients])  # type: ignore[no-untyped-call]
            for gradient, part in zip(gradients, parts, strict=True):
                gradient.copy_(part.view_as(gradient))

    def agree(self, flag: bool) -> bool:
        """True when any rank says so; ranks must ask together."""
        if self.size == 1:
            return flag
        votes = torch.tensor([float(flag)])
        dist.all_reduce(votes)
        return bool(votes.item() > 0)


def own_device(name: str) -> torch.device:
    """Return compute_device(name), but under torchrun the GPU of this rank (LOCAL_RANK) where name has no number.

    Raises:
        DeviceError: there is no such device, or there are fewer GPUs than ranks.
    """
    device, number = compute_device(name), os.environ.get("LOCAL_RANK")
    if device.type == CPU or number is None or ":" in name:
        return device
    return compute_device(f"{CUDA}:{number}")


def join(device: str = CPU) -> Ranks:
    """Join the process group that torchrun announces (RANK, WORLD_SIZE); one rank without torchrun.

    Args:
        device: that the learner computes on, by its setting.

    Raises:
        DeviceError: as own_device.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return Ranks()
    if not dist.is_initialized():
        # A rank waits for the next rollout as long as the learner has no goal; torchrun ends it when another one dies.
        dist.init_process_group(BACKENDS[own_device(device).type], timeout=timedelta(days=365))
    return Ranks(dist.get_rank(), size)


def broadcast_rollout(rollout: Rollout | None, ranks: Ranks) -> Rollout | None:
    """Rank 0 gives its rollout to all ranks; None from rank 0 means that there are no more. Nothing is pickled."""
    if ranks.size == 1:
        return rollout
    layout: Any = None
    if ranks.rank == 0 and rollout is not None:
        arrays = {f.name: getattr(rollout, f.name) for f in fields(rollout) if f.name != "policy_version"}
        layout = [rollout.policy_version, {name: (a.shape, str(a.dtype)) for name, a in arrays.items()}]
    text = _broadcast_bytes(None if layout is None else json.dumps(layout).encode(), ranks)
    if text is None:
        return None
    version, shapes = json.loads(text)
    received: dict[str, Any] = {}
    for name, (shape, dtype) in shapes.items():
        source = np.ascontiguousarray(getattr(rollout, name)) if ranks.rank == 0 else np.empty(shape, dtype)
        data = torch.from_numpy(source.view(np.uint8).reshape(-1).copy())
        dist.broadcast(data, src=0)
        received[name] = data.numpy().view(dtype).reshape(shape)
    return Rollout(policy_version=version, **received)


def _broadcast_bytes(data: bytes | None, ranks: Ranks) -> bytes | None:
    """Rank 0 gives its bytes to all ranks; None from rank 0 means that there are no more."""
    if ranks.size == 1:
        return data
    size = torch.tensor([-1 if data is None else len(data)])
    dist.broadcast(size, src=0)
    if size.item() < 0:
        return None
    content = torch.empty(int(size.item()), dtype=torch.uint8)
    if ranks.rank == 0:
        content = torch.frombuffer(bytearray(data or b""), dtype=torch.uint8)
    dist.broadcast(content, src=0)
    return content.numpy().tobytes()
