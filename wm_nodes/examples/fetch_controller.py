"""Scripted controllers of your own as the policy that is recorded: they see the red ball of FetchReach, or block and
red spot of FetchPush, in two cameras.

python -m examples.record /tmp/reach --preset fetch_reach --policy.factory examples.fetch_controller:reach
"""
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.environments import CameraView
from wm_nodes.config.schema import RunConfig
from wm_nodes.policy_rl.gaussian import DiagonalGaussian
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy

FOCAL_HEIGHTS, STEP_M = 0.5 / np.tan(np.pi / 8), 0.02


class Reach(ImagePolicy):
    beside_m = 0.0

    def distribution(self, features_BF: Tensor, states_BS: Tensor) -> DiagonalGaussian:
        aim_B3 = features_BF + self.beside_m * torch.sin(300 * features_BF.roll(1, 1))
        return self.along(aim_B3 - states_BS)

    def along(self, way_B3: Tensor) -> DiagonalGaussian:
        """The actions that go this way, m, as fast as they may."""
        mean_B3 = (way_B3 / STEP_M).clamp(-1, 1)
        return DiagonalGaussian(torch.nn.functional.pad(mean_B3, (0, 1)), self.log_std_A.detach())


def is_red(images: Tensor) -> Tensor:
    """(...,) of pictures (..., 3)."""
    return (images[..., 0] > 90) & (images[..., 1:] < 60).all(-1)


def line_of_sight(view: CameraView, down: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Where the camera is (3,), and directions (..., 3) to points that far down and right, in depths."""
    a, e = np.radians([view.azimuth_deg, view.elevation_deg])
    ahead = torch.tensor([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]).float()
    up = torch.tensor([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]).float()
    sight = ahead + right[..., None] * torch.linalg.cross(ahead, up) - down[..., None] * up
    return torch.tensor(view.lookat_m) - view.distance_m * ahead, sight


def reach(config: RunConfig) -> Reach:
    views, (height, width) = list(config.gymnasium.cameras.values()), config.gymnasium.image_size

    def ball(images_BHWC: Tensor) -> Tensor:
        """Where (B, 3) the lines of sight of the red pixels' middles meet; the middle of the view pulls a little."""
        matrix, vector = 0.01 * torch.eye(3), 0.01 * torch.tensor(views[0].lookat_m)
        for view, picture in zip(views, torch.split(images_BHWC.int(), width, 2), strict=True):
            red = is_red(picture).float()
            rows, columns = torch.arange(height) + 0.5 - height / 2, torch.arange(width) + 0.5 - width / 2
            seen = red.sum((1, 2))
            down, right = ((red * offset).sum((1, 2)) / seen.clamp(min=1) / (FOCAL_HEIGHTS * height)
                           for offset in (rows[:, None], columns))
            camera, sight = line_of_sight(view, down, right)
            sight = torch.nn.functional.normalize(sight, dim=1)
            across = (torch.eye(3) - sight[:, :, None] * sight[:, None]) * (seen > 0)[:, None, None]
            matrix, vector = matrix + across, vector + across @ camera
        place_B3: Tensor = torch.linalg.solve(matrix, vector)
        return place_B3

    return Reach(ImageEncoder(ball, 3), 3, 4, config.policy, seed=config.seed)


class Push(Reach):
    """Above the block to its far side, down, then towards the spot."""

    def distribution(self, features_BF: Tensor, states_BS: Tensor) -> DiagonalGaussian:
        block_B2, spot_B2 = features_BF[:, :2], features_BF[:, 2:]
        hand_B2, height_B = states_BS[:, :2], states_BS[:, 2]
        spot_B2 = spot_B2 + self.beside_m * torch.sin(100 * spot_B2.roll(1, 1))
        ahead_B2 = torch.nn.functional.normalize(spot_B2 - block_B2, dim=1)
        behind_B2, from_block_B2 = block_B2 - 0.06 * ahead_B2 - hand_B2, hand_B2 - block_B2
        along_B = (from_block_B2 * ahead_B2).sum(1)
        aside_B2 = from_block_B2 - along_B[:, None] * ahead_B2
        is_low, is_there = height_B < 0.465, behind_B2.norm(dim=1) < 0.025
        pushes = is_low & (along_B < -0.02) & (along_B > -0.1) & (aside_B2.norm(dim=1) < 0.035)
        is_stuck = (height_B < 0.48) & (from_block_B2.norm(dim=1) < 0.09) & ~is_there
        across_B2 = torch.where(pushes[:, None], 0.03 * ahead_B2 - 0.5 * aside_B2, behind_B2 * ~is_stuck[:, None])
        up_B = torch.where(pushes | is_there, 0.415, 0.5) - height_B
        return self.along(torch.cat([across_B2, up_B[:, None]], 1))


def push(config: RunConfig) -> Push:
    height, width = config.gymnasium.image_size
    down, right = ((torch.arange(n) + 0.5 - n / 2) / (FOCAL_HEIGHTS * height) for n in (height, width))
    lines = [line_of_sight(view, *torch.meshgrid(down, right, indexing="ij"))
             for view in config.gymnasium.cameras.values()]
    spots, tops = (torch.cat([(at + sight * ((z - at[2]) / sight[..., 2:]))[..., :2] for at, sight in lines], 1)
                   for z in (0.43, 0.45))
    on_table = ((tops - torch.tensor([1.34, 0.75])).abs() < 0.2).all(-1)

    def places(images_BHWC: Tensor) -> Tensor:
        """Middle (B, 4) of the block's dark grey top and of the red spot, on the table; 0 where unseen."""
        low, high = images_BHWC.int().amin(-1), images_BHWC.int().amax(-1)
        grey = (low > 65) & (high < 82) & (high - low < 4) & on_table
        seen = [torch.where(mask[..., None], grid, torch.nan).flatten(1, 2).nanmedian(1)[0]
                for mask, grid in ((grey, tops), (is_red(images_BHWC), spots))]
        return torch.cat(seen, 1).nan_to_num()

    return Push(ImageEncoder(places, 4), 3, 4, config.policy, seed=config.seed)


def beside(make: Callable[[RunConfig], Reach], beside_m: float) -> Callable[[RunConfig], Reach]:
    """One that aims beside the goal: for a model that has seen more than success."""
    def controller(config: RunConfig) -> Reach:
        policy = make(config)
        policy.beside_m = beside_m
        return policy

    return controller


astray, push_astray = beside(reach, 0.15), beside(push, 0.15)
near, push_near = beside(reach, 0.07), beside(push, 0.08)  # about half as many succeed: they show where success begins
