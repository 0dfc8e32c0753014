"""Several learner processes under torchrun (gloo or nccl): every rank holds the whole rollout and a share of each
minibatch; gradients are summed, so R ranks make the update of one."""

import os
from dataclasses import fields
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from wm_nodes.types import Rollout


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
        if self.size > 1:
            gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in module.parameters()]
            flat = torch.cat([gradient.flatten() for gradient in gradients])
            dist.all_reduce(flat)
            for parameter, part in zip(module.parameters(), flat.split([g.numel() for g in gradients]), strict=True):
                parameter.grad = part.view_as(parameter).clone()

    def agree(self, flag: bool) -> bool:
        """True when any rank says so; ranks must ask together."""
        if self.size == 1:
            return flag
        votes = torch.tensor([float(flag)])
        dist.all_reduce(votes)
        return bool(votes.item() > 0)


def join() -> Ranks:
    """Join the process group that torchrun announces (RANK, WORLD_SIZE); one rank without torchrun."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return Ranks()
    if not dist.is_initialized():
        dist.init_process_group("gloo")
    return Ranks(dist.get_rank(), size)


def broadcast_rollout(rollout: Rollout | None, ranks: Ranks) -> Rollout | None:
    """Rank 0 gives its rollout to all ranks; None from rank 0 means that there are no more."""
    if ranks.size == 1:
        return rollout
    layout: list[Any] = [None]
    if ranks.rank == 0 and rollout is not None:
        arrays = {f.name: getattr(rollout, f.name) for f in fields(rollout) if f.name != "policy_version"}
        layout = [(rollout.policy_version, {name: (a.shape, str(a.dtype)) for name, a in arrays.items()})]
    dist.broadcast_object_list(layout, src=0)
    if layout[0] is None:
        return None
    version, shapes = layout[0]
    received: dict[str, Any] = {}
    for name, (shape, dtype) in shapes.items():
        source = np.ascontiguousarray(getattr(rollout, name)) if ranks.rank == 0 else np.empty(shape, dtype)
        data = torch.from_numpy(source.view(np.uint8).reshape(-1).copy())
        dist.broadcast(data, src=0)
        received[name] = data.numpy().view(dtype).reshape(shape)
    return Rollout(policy_version=version, **received)
