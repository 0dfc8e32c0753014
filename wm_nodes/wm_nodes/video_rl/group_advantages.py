"""Group-relative advantages of GRPO. Shapes: N videos, each of one group (one context); DD-13 to DD-13c.

Computed in float64: in float32 a group of equal rewards gets advantages of up to 0.9 from rounding alone.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.core.types import BoolArray

StdScope = Literal["group", "global", "batch", "running"]


@dataclass
class RunningStd:
    """Variance of every reward seen so far about its group's mean, for std_scope running."""

    sum_of_squares: float = 0.0
    count: int = 0

    def add(self, deviations: Tensor) -> None:
        self.sum_of_squares += float(deviations.square().sum())
        self.count += deviations.numel()

    @property
    def std(self) -> float:
        return (self.sum_of_squares / self.count) ** 0.5 if self.count else 0.0


@dataclass(frozen=True)
class GroupAdvantages:
    """advantages_N: float64, 0 where there is none. kept_N: bool, videos that train: their reward is valid and their
    group's rewards differ. num_groups, num_zero_std: groups; groups without any spread.
    """

    advantages_N: Tensor
    kept_N: Tensor
    num_groups: int
    num_zero_std: int


def group_advantages(
    rewards_N: Tensor, group_ids_N: Tensor, valid_N: Tensor, *, clip: float, std_scope: StdScope = "group",
    ddof: int = 0, floor: float = 1e-6, running: RunningStd | None = None,
) -> GroupAdvantages:
    """Return A_i = clip((R_i - mean_g R) / std_g R, -clip, clip) (DD-13) over the valid videos of each group.

    The mean is always the group's. std_scope says which standard deviation:

    - group: of the group's rewards.
    - global: sqrt(mean (R_i - mean_g R)^2) over the videos of all groups with spread, about their groups' own means.
      Contexts of unequal difficulty do not enter it. This is not the global_std of flow_grpo's code; that is batch.
    - batch: of all valid rewards about their common mean, also those of groups without spread. Where contexts differ in
      difficulty it is larger than global, and the advantages are smaller.
    - running: as global, over every buffer so far.

    A group of fewer than two valid videos, or with std < floor max(1, |mean|), has advantages 0 and is counted.

    Args:
        ddof: 0 population, 1 sample standard deviation (of the group's). The largest |A| a group of G can reach is
            sqrt(G - 1) with ddof 0, so a clip of 5 never acts below G = 27.
        running: state of std_scope running, updated here.

    Raises:
        ValueError: a reward marked valid is not finite, a shape differs, or `running` is missing.
    """
    if not rewards_N.shape == group_ids_N.shape == valid_N.shape:
        raise ValueError(
            f"rewards, group ids and valid must have one shape, got {tuple(rewards_N.shape)}, "
            f"{tuple(group_ids_N.shape)}, {tuple(valid_N.shape)}"
        )
    if std_scope == "running" and running is None:
        raise ValueError("std_scope running needs its RunningStd")
    rewards, valid = rewards_N.double(), valid_N.bool()
    if not bool(torch.isfinite(rewards[valid]).all()):
        video = int(torch.nonzero(valid & ~torch.isfinite(rewards))[0])
        raise ValueError(f"reward of video {video} is {float(rewards[video])}; mark it valid=False to leave it out")
    deviations, kept = torch.zeros_like(rewards), torch.zeros_like(valid)
    stds, groups, num_zero = torch.ones_like(rewards), _groups(group_ids_N), 0
    for group in groups:
        members = (group_ids_N == group) & valid
        values = rewards[members]
        std = float(values.std(correction=ddof)) if len(values) > 1 else 0.0
        if std < floor * max(1.0, abs(float(values.mean())) if len(values) else 1.0):
            num_zero += 1
            continue
        deviations[members], stds[members] = values - values.mean(), std
        kept |= members
    if running is not None:
        running.add(deviations[kept])
    if std_scope == "global" and bool(kept.any()):
        stds = torch.full_like(stds, float(deviations[kept].square().mean().sqrt()))
    elif std_scope == "batch" and bool(kept.any()):
        stds = torch.full_like(stds, float(rewards[valid].std(correction=0)))
    elif std_scope == "running" and running is not None and running.std > 0:
        stds = torch.full_like(stds, running.std)
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


def mixed_advantages(
    rewards: Mapping[str, Tensor], weights: Mapping[str, float], group_ids_N: Tensor, valid_N: Tensor, *, clip: float,
    std_scope: StdScope = "group", ddof: int = 0, floor: float = 1e-6,
) -> GroupAdvantages:
    """Return clip(sum_r w_r A_r / sum_r |w_r|) of rewards normalised one by one (DD-13a).

    A_r is DD-13 of reward r, unclipped. A group counts as one without spread where no reward has any.

    Raises:
        ValueError: no weight that is not 0, a weight of an unknown reward, or as group_advantages.
    """
    weights = {name: weight for name, weight in weights.items() if weight}
    unknown = sorted(set(weights) - set(rewards))
    if unknown or not weights:
        raise ValueError(f"no advantages of unknown rewards {unknown}; weigh some of {', '.join(sorted(rewards))}")
    parts = {
        name: group_advantages(
            rewards[name], group_ids_N, valid_N, clip=math.inf, std_scope=std_scope, ddof=ddof, floor=floor
        )
        for name in weights
    }
    total = sum(abs(weight) for weight in weights.values())
    mixed = torch.stack([weight * parts[name].advantages_N for name, weight in weights.items()]).sum(0) / total
    kept = torch.stack([part.kept_N for part in parts.values()]).any(0)
    groups, spread = _groups(group_ids_N), set(_groups(group_ids_N[kept]))
    return GroupAdvantages(mixed.clamp(-clip, clip), kept, len(groups), len(groups) - len(spread))


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


def win_rates(rewards_N: Tensor, group_ids_N: Tensor, valid_N: Tensor) -> Tensor:
    """Return Pref-GRPO's reward (DD-13c): each valid video's share of wins within its group; ties count half."""
    rates = torch.full_like(rewards_N, float("nan"), dtype=torch.float64)
    for group in _groups(group_ids_N):
        members = (group_ids_N == group) & valid_N.bool()
        values = rewards_N[members].double()
        if len(values) > 1:
            wins = (values[:, None] > values[None]).double() + 0.5 * (values[:, None] == values[None]).double()
            rates[members] = (wins.sum(1) - 0.5) / (len(values) - 1)
    return rates
