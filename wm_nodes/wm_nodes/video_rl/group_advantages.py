"""Group-relative advantages of GRPO. Shapes: N videos, each of one group (one context); DD-13, DD-13b.

Computed in float64: in float32 a group of equal rewards gets advantages of up to 0.9 from rounding alone.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.core.types import BoolArray

FLOOR = 1e-6
"""A group with std < FLOOR max(1, |mean|) has no spread."""


@dataclass(frozen=True)
class GroupAdvantages:
    """The advantages of a buffer."""

    advantages_N: Tensor
    """float64, 0 where there is none."""
    kept_N: Tensor
    """bool, videos that train: their reward is valid and their group's rewards differ."""
    num_groups: int
    """All of them."""
    num_zero_std: int
    """Groups without any spread."""


def group_advantages(
    rewards_N: Tensor, group_ids_N: Tensor, valid_N: Tensor, *, clip: float,
    std_scope: Literal["group", "global"] = "group",
) -> GroupAdvantages:
    """Return A_i = clip((R_i - mean_g R) / std_g R, -clip, clip) (DD-13) over the valid videos of each group.

    The mean is always the group's. std_scope says which standard deviation:

    - group: of the group's rewards, with n. The largest |A| a group of G can reach is sqrt(G - 1), so a clip of 5 never
      acts below G = 27.
    - global: sqrt(mean (R_i - mean_g R)^2) over the videos of all groups with spread, about their groups' own means.
      Contexts of unequal difficulty do not enter it. This is not the global_std of flow_grpo's code, which is the std
      of all rewards about their common mean.

    A group of fewer than two valid videos, or with std < FLOOR max(1, |mean|), has advantages 0 and is counted.

    Raises:
        ValueError: a reward marked valid is not finite, or a shape differs.
    """
    if not rewards_N.shape == group_ids_N.shape == valid_N.shape:
        raise ValueError(
            f"rewards, group ids and valid must have one shape, got {tuple(rewards_N.shape)}, "
            f"{tuple(group_ids_N.shape)}, {tuple(valid_N.shape)}"
        )
    rewards, valid = rewards_N.double(), valid_N.bool()
    if not bool(torch.isfinite(rewards[valid]).all()):
        video = int(torch.nonzero(valid & ~torch.isfinite(rewards))[0])
        raise ValueError(f"reward of video {video} is {float(rewards[video])}; mark it valid=False to leave it out")
    deviations, kept = torch.zeros_like(rewards), torch.zeros_like(valid)
    stds, groups, num_zero = torch.ones_like(rewards), _groups(group_ids_N), 0
    for group in groups:
        members = (group_ids_N == group) & valid
        values = rewards[members]
        std = float(values.std(correction=0)) if len(values) > 1 else 0.0
        if std < FLOOR * max(1.0, abs(float(values.mean())) if len(values) else 1.0):
            num_zero += 1
            continue
        deviations[members], stds[members] = values - values.mean(), std
        kept |= members
    if std_scope == "global" and bool(kept.any()):
        stds = torch.full_like(stds, float(deviations[kept].square().mean().sqrt()))
    advantages = (deviations / stds).clamp(-clip, clip)
    return GroupAdvantages(advantages, kept, len(groups), num_zero)


def trainable(valid_N: BoolArray, group_ids_N: NDArray[np.int64]) -> BoolArray:
    """Return which clips train (RA-15), (N,): the valid ones of groups with n_valid >= max(2, G / 2)."""
    if valid_N.shape != group_ids_N.shape:
        raise ValueError(f"valid and group ids must have one shape, got {valid_N.shape} and {group_ids_N.shape}")
    kept = np.zeros(valid_N.shape, bool)
    for group in np.unique(group_ids_N):
        members = group_ids_N == group
        kept[members] = valid_N[members] & (valid_N[members].sum() >= max(2, members.sum() / 2))
    return kept


def best_of_n(advantages_N: Tensor, group_ids_N: Tensor, kept_N: Tensor, n: int) -> Tensor:
    """Return which videos stay (DD-13b), bool (N,): of those kept the n // 2 best and n - n // 2 worst of each group.

    n = 0, or a group that is not larger than n: all stay. Equal advantages are ordered by their index.
    """
    if n < 0:
        raise ValueError(f"n must be >= 0, got {n}")
    chosen = kept_N.clone().bool()
    for group in _groups(group_ids_N):
        members = torch.nonzero((group_ids_N == group) & kept_N).flatten()
        if 0 < n < len(members):
            order = members[torch.sort(advantages_N[members], stable=True).indices]
            chosen[order[n - n // 2 : len(order) - n // 2]] = False
    return chosen


def _groups(group_ids_N: Tensor) -> list[int]:
    return sorted({int(group) for group in group_ids_N})
