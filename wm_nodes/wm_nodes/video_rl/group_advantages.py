"""Group-relative advantages of GRPO. Shapes: N videos, each of one group (one context); DD-13, DD-13b, RA-15.

Computed in float64: in float32 a group of equal rewards gets advantages of up to 0.9 from rounding alone.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

FLOOR = 1e-6
"""A group with std < FLOOR max(1, |mean|) has no spread."""


@dataclass(frozen=True)
class GroupAdvantages:
    """The advantages of a buffer."""

    advantages_N: Tensor
    """float64, 0 where there is none."""
    kept_N: Tensor
    """bool, videos that train: they have a reward, and their group's rewards differ."""
    num_groups: int
    """All of them."""
    num_dropped: int
    """Groups of G videos of which fewer than max(2, G / 2) have a reward (RA-15)."""
    num_zero_std: int
    """Groups without any spread, those that are dropped among them."""


def group_advantages(
    rewards_N: Tensor, group_ids_N: Tensor, *, clip: float, std_scope: Literal["group", "global"] = "group"
) -> GroupAdvantages:
    """Return A_i = clip((R_i - mean_g R) / std_g R, -clip, clip) (DD-13) over the videos of each group whose reward is
    finite.

    The mean is always the group's. std_scope says which standard deviation:

    - group: of the group's rewards, with n. The largest |A| a group of G can reach is sqrt(G - 1), so a clip of 5 never
      acts below G = 27.
    - global: sqrt(mean (R_i - mean_g R)^2) over the videos of all groups with spread, about their groups' own means.
      Contexts of unequal difficulty do not enter it. This is not the global_std of flow_grpo's code, which is the std
      of all rewards about their common mean.

    A group that is dropped, or with std < FLOOR max(1, |mean|), has advantages 0.
    """
    rewards = rewards_N.double()
    valid, deviations, stds = torch.isfinite(rewards), torch.zeros_like(rewards), torch.ones_like(rewards)
    kept, groups, num_dropped, num_zero = torch.zeros_like(valid), sorted(set(group_ids_N.tolist())), 0, 0
    for group in groups:
        of_group = group_ids_N == group
        members = of_group & valid
        values = rewards[members]
        dropped = len(values) < max(2, int(of_group.sum()) / 2)
        num_dropped += dropped
        if dropped or float(values.std(correction=0)) < FLOOR * max(1.0, abs(float(values.mean()))):
            num_zero += 1
            continue
        deviations[members], stds[members] = values - values.mean(), values.std(correction=0)
        kept |= members
    if std_scope == "global" and bool(kept.any()):
        stds = torch.full_like(stds, float(deviations[kept].square().mean().sqrt()))
    advantages = (deviations / stds).clamp(-clip, clip)
    return GroupAdvantages(advantages, kept, len(groups), num_dropped, num_zero)


def best_of_n(advantages_N: Tensor, group_ids_N: Tensor, kept_N: Tensor, n: int) -> Tensor:
    """Return which videos stay (DD-13b), bool (N,): of those kept the n // 2 best and n - n // 2 worst of each group.

    n = 0, or a group that is not larger than n: all stay. Equal advantages are ordered by their index.
    """
    chosen = kept_N.clone().bool()
    for group in sorted(set(group_ids_N.tolist())):
        members = torch.nonzero((group_ids_N == group) & kept_N).flatten()
        if 0 < n < len(members):
            order = members[torch.sort(advantages_N[members], stable=True).indices]
            chosen[order[n - n // 2 : len(order) - n // 2]] = False
    return chosen
