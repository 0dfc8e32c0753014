"""A scripted controller of your own as the policy that is recorded: it sees the red ball of FetchReach in two cameras.

python -m examples.record /tmp/reach --preset fetch_reach --policy.factory examples.fetch_controller:reach
"""
import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.schema import RunConfig
from wm_nodes.policy_rl.gaussian import DiagonalGaussian
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy

FOCAL_HEIGHTS, STEP_M = 0.5 / np.tan(np.pi / 8), 0.02


class Reach(ImagePolicy):
    beside_m = 0.0

    def distribution(self, features_BF: Tensor, states_BS: Tensor) -> DiagonalGaussian:
        aim_B3 = features_BF + self.beside_m * torch.sin(300 * features_BF.roll(1, 1))
        mean_B3 = ((aim_B3 - states_BS) / STEP_M).clamp(-1, 1)
        return DiagonalGaussian(torch.nn.functional.pad(mean_B3, (0, 1)), self.log_std_A.detach())


def reach(config: RunConfig) -> Reach:
    views, (height, width) = list(config.gymnasium.cameras.values()), config.gymnasium.image_size

    def ball(images_BHWC: Tensor) -> Tensor:
        """Where (B, 3) the lines of sight of the red pixels' middles meet; the middle of the view pulls a little."""
        matrix, vector = 0.01 * torch.eye(3), 0.01 * torch.tensor(views[0].lookat_m)
        for view, picture in zip(views, torch.split(images_BHWC.int(), width, 2), strict=True):
            a, e = np.radians([view.azimuth_deg, view.elevation_deg])
            ahead = torch.tensor([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]).float()
            up = torch.tensor([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]).float()
            red = ((picture[..., 0] > 90) & (picture[..., 1:] < 60).all(-1)).float()
            rows, columns = torch.arange(height) + 0.5 - height / 2, torch.arange(width) + 0.5 - width / 2
            seen = red.sum((1, 2))
            down, right = ((red * offset).sum((1, 2)) / seen.clamp(min=1) / (FOCAL_HEIGHTS * height)
                           for offset in (rows[:, None], columns))
            sight = ahead + right[:, None] * torch.linalg.cross(ahead, up) - down[:, None] * up
            sight = torch.nn.functional.normalize(sight, dim=1)
            across = (torch.eye(3) - sight[:, :, None] * sight[:, None]) * (seen > 0)[:, None, None]
            matrix, vector = matrix + across, vector + across @ (torch.tensor(view.lookat_m) - view.distance_m * ahead)
        place_B3: Tensor = torch.linalg.solve(matrix, vector)
        return place_B3

    return Reach(ImageEncoder(ball, 3), 3, 4, config.policy, seed=config.seed)


def astray(config: RunConfig) -> Reach:
    """Aims beside the ball, mostly: for a model that has seen more than success."""
    policy = reach(config)
    policy.beside_m = 0.15
    return policy


def near(config: RunConfig) -> Reach:
    """Aims so little beside the ball that about half of the episodes succeed: they show where success begins."""
    policy = reach(config)
    policy.beside_m = 0.07
    return policy
