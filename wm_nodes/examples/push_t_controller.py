"""A scripted controller of PushT as the policy that is recorded: it sees the grey T in a picture, and pushes it where
one short push brings it nearest to the green one.

python -m examples.record /tmp/push_t --preset push_t --policy.factory examples.push_t_controller:push
"""
import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.schema import RunConfig
from wm_nodes.policy_rl.gaussian import DiagonalGaussian
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy

TABLE_PX = 512
AREA_CENTRE, CENTRE = torch.tensor([0.0, 40.7]), torch.tensor([0.0, 45.0])
"""Of the T in its own frame, px: of its area, and where it turns about."""
GOAL_ANGLE = np.pi / 4
GOAL = torch.tensor([256.0, 256.0]) + torch.tensor([-CENTRE[1], CENTRE[1]]) * np.sqrt(0.5)
TURN_PX, REACH_PX = 50.0, 15.0
"""How far from its middle a push turns the T as much as it moves it; the pusher's radius."""
EDGES = (  # from, to, inwards, pushes along it
    ((-60, 0), (60, 0), (0, 1), 5), ((-60, 30), (-15, 30), (0, -1), 2), ((15, 30), (60, 30), (0, -1), 2),
    ((-60, 0), (-60, 30), (1, 0), 1), ((60, 0), (60, 30), (-1, 0), 1), ((-15, 30), (-15, 120), (1, 0), 4),
    ((15, 30), (15, 120), (-1, 0), 4), ((-15, 120), (15, 120), (0, -1), 1),
)
POINTS_P2, INWARDS_P2 = (torch.tensor(np.concatenate(parts), dtype=torch.float32) for parts in zip(*(
    (np.linspace(start, end, 2 * n + 1)[1::2], [inwards] * n) for start, end, inwards, n in EDGES
)))


def turned(vectors: Tensor, angle_B: Tensor) -> Tensor:
    """Vectors (P, 2) by the angle, (B, P, 2)."""
    cos, sin = angle_B.cos()[:, None], angle_B.sin()[:, None]
    x, y = vectors[:, 0], vectors[:, 1]
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def pose(images_BHWC: Tensor) -> Tensor:
    """Middle, px, and angle (B, 3) of the grey T, by the moments of its pixels: it is longer, and thinner to one side,
    along its stem."""
    size = images_BHWC.shape[1]
    red, green, blue = images_BHWC.float().unbind(-1)
    grey = (red > 80) & (red < 185) & (green < 185) & (blue - red > 8) & (blue - red < 60)
    weight = torch.where(grey, (255 - red) / 136, 0.0).clamp(max=1)
    weight = weight / weight.sum((1, 2), keepdim=True).clamp(min=1e-6)
    places = (torch.arange(size) + 0.5) * TABLE_PX / size
    down, right = torch.meshgrid(places, places, indexing="ij")
    x, y = (((weight * axis).sum((1, 2), keepdim=True)) for axis in (right, down))
    dx, dy = right - x, down - y
    along = 0.5 * torch.atan2(2 * (weight * dx * dy).sum((1, 2)), (weight * (dx * dx - dy * dy)).sum((1, 2)))
    stem = dx * along.cos()[:, None, None] + dy * along.sin()[:, None, None]
    along = torch.where((weight * stem**3).sum((1, 2)) < 0, along + np.pi, along) - np.pi / 2
    middle = torch.cat([x[:, 0], y[:, 0]], 1) + turned((CENTRE - AREA_CENTRE)[None], along)[:, 0]
    return torch.cat([middle, along[:, None]], 1)


class Push(ImagePolicy):
    """To the side of the best push, round the T, and then along it."""

    def distribution(self, features_BF: Tensor, states_BS: Tensor) -> DiagonalGaussian:
        middle_B2, angle_B = features_BF[:, :2], features_BF[:, 2]
        off_B12, off_angle_B1 = (GOAL - middle_B2)[:, None], wrapped(GOAL_ANGLE - angle_B)[:, None]
        arm, inwards = turned(POINTS_P2 - CENTRE, angle_B), turned(INWARDS_P2, angle_B)
        turn = arm[..., 0] * inwards[..., 1] - arm[..., 1] * inwards[..., 0]
        share = 1 / (1 + (turn / TURN_PX) ** 2)
        use = share * ((inwards * off_B12).sum(-1) + turn * off_angle_B1)
        length = (use / share).clamp(0, 25)
        gain = (2 * length * use - length**2 * share).clamp(min=0)
        begin = middle_B2[:, None] + arm - (REACH_PX + 12) * inwards
        free = ((begin > 10) & (begin < TABLE_PX - 10)).all(-1)
        worth = gain.sqrt() - 0.05 * (begin - states_BS[:, None]).norm(dim=-1)
        best = torch.where(free, worth, -torch.inf).argmax(1)
        rows = torch.arange(len(best))
        touch_B2, inwards_B2, length_B = middle_B2 + arm[rows, best], inwards[rows, best], length[rows, best]
        target_B2 = self.round_about(states_BS, middle_B2, begin[rows, best])
        depth_B = ((states_BS - touch_B2) * inwards_B2).sum(1)
        aside_B = ((states_BS - touch_B2) - depth_B[:, None] * inwards_B2).norm(dim=1)
        pushes = (depth_B < 0) & (depth_B > -REACH_PX - 30) & (aside_B < 8)
        pushed_B2 = touch_B2 + (length_B.clamp(max=12) - REACH_PX)[:, None] * inwards_B2
        mean_B2 = torch.where(pushes[:, None], pushed_B2, target_B2) * 2 / TABLE_PX - 1
        return DiagonalGaussian(mean_B2.clamp(-1, 1), self.log_std_A.detach())

    def round_about(self, pusher_B2: Tensor, middle_B2: Tensor, end_B2: Tensor) -> Tensor:
        """The next place, at most 40 px on, of a way to `end` that does not touch the T."""
        here, there = pusher_B2 - middle_B2, end_B2 - middle_B2
        angle = torch.atan2(here[:, 1], here[:, 0])
        left = wrapped(torch.atan2(there[:, 1], there[:, 0]) - angle)
        radius, on = there.norm(dim=1).clamp(min=110), angle + left.clamp(-0.4, 0.4)
        arc = middle_B2 + radius[:, None] * torch.stack([on.cos(), on.sin()], 1)
        straight = (left.abs() < 0.25) | ((end_B2 - pusher_B2).norm(dim=1) < 20)
        step = torch.where(straight[:, None], end_B2, arc) - pusher_B2
        shorter_B2: Tensor = step * (40 / step.norm(dim=1, keepdim=True).clamp(min=40))
        return (pusher_B2 + shorter_B2).clamp(12, TABLE_PX - 12)


def wrapped(angles: Tensor) -> Tensor:
    """In [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def push(config: RunConfig) -> Push:
    return Push(ImageEncoder(pose, 3), 2, 2, config.policy, seed=config.seed)
