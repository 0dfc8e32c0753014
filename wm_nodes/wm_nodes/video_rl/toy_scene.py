"""A toy world for GRPO of video models: a disc on a texture with a commanded direction. Scored by DD-29.

Shapes: B scenes, C = 2 channels, F = 6 frames, H = W = 16 cells, or the same scene in more of them. A "latent" video is
the picture itself. In the training videos the disc obeys its action with probability OBEDIENCE and else takes a random
direction, so a trained model knows the right motion and reinforcement learning has something to teach. Scores come from
the pixels alone; lengths are in cells of the 16 x 16 picture at every resolution.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from wm_nodes.config.shipped import PRETRAINED
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import device_of
from wm_nodes.core.seeding import stream_seed, torch_stream
from wm_nodes.training.weights import load_weights_file
from wm_nodes.video_model import (
    Condition,
    NetworkSettings,
    RolloutBuffer,
    VideoNetwork,
    initial_noise,
    sample_videos,
)
from wm_nodes.video_rl.sampling import sample_buffer

CHANNELS, FRAMES, SIDE = 2, 6, 16
NUM_ACTIONS = 4
RADIUS = 1.7
DIRECTIONS = torch.tensor([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]])
"""(row, column) of actions 0 to 3: right, left, down, up."""
BASE = PRETRAINED / "moving_disc" / "video_model.safetensors"
NETWORK = NetworkSettings(channels=CHANNELS, action_dim=NUM_ACTIONS, width=32, depth=5)
COLOUR = torch.tensor([2.0, -2.0])
MOVED_CELLS = 2.0
"""A disc that went further than this the commanded way obeyed."""
NEAR = 3.0
"""Cells further than NEAR radii from the disc are background."""
MAX_SEED = 2**62
CHANGE = 0.02
"""Mean square change from frame to frame at which `consistency` is 1 / e; a moving disc makes about 0.025."""


@dataclass(frozen=True)
class Scenes:
    """Scenes of one size."""

    background: Tensor
    """(B, C, H, W), H = W."""
    start: Tensor
    """(B, 2) row, column."""
    speed: Tensor
    """(B,) pixels per frame."""
    action: Tensor
    """int64 (B,)."""

    def __len__(self) -> int:
        return len(self.action)

    @property
    def side(self) -> int:
        return self.background.shape[-1]

    @property
    def scale(self) -> float:
        """Pixels per cell."""
        return self.side / SIDE

    def path(self, direction: Tensor) -> Tensor:
        """Centres (B, F, 2) of discs that go in `direction`, int64 (B,)."""
        steps = torch.arange(FRAMES, dtype=torch.float32, device=self.start.device)
        way = DIRECTIONS.to(self.start.device)[direction]
        return self.start[:, None] + steps[None, :, None] * self.speed[:, None, None] * way[:, None]

    def videos(self, direction: Tensor) -> Tensor:
        """Render (B, C, F, H, W)."""
        alpha = opacity_at(self.path(direction), RADIUS * self.scale, self.side)[:, None]
        return self.background[:, :, None] * (1 - alpha) + COLOUR.to(alpha.device).view(1, 2, 1, 1, 1) * alpha

    def rows(self, index: Tensor) -> "Scenes":
        """Return the scenes of `index`, int64 (B,)."""
        return Scenes(self.background[index], self.start[index], self.speed[index], self.action[index])

    def to(self, device: torch.device) -> "Scenes":
        return Scenes(*(tensor.to(device) for tensor in vars(self).values()))

    def condition(self) -> Condition:
        """The clean first frame and the commanded action, one-hot on every frame."""
        actions = F.one_hot(self.action, NUM_ACTIONS).float()[:, None].expand(-1, FRAMES - 1, -1).contiguous()
        return Condition(self.videos(self.action)[:, :, :1].contiguous(), actions, torch.zeros(len(self), 1, 0))


def draw_scenes(count: int, seed: int, name: str, index: int = 0, side: int = SIDE) -> Scenes:
    """Draw scenes of side x side pixels; the same scenes at every resolution."""
    generator, scale = torch_stream(seed, f"moving_disc_{name}", index), side / SIDE
    coarse = 0.5 * torch.randn(count, CHANNELS, 4, 4, generator=generator)
    return Scenes(
        background=F.interpolate(coarse, size=(side, side), mode="bilinear", align_corners=True),
        start=(side - 1) / 2 + 2 * scale * torch.rand(count, 2, generator=generator) - scale,
        speed=scale * (0.9 + 0.2 * torch.rand(count, generator=generator)),
        action=torch.randint(NUM_ACTIONS, (count,), generator=generator),
    )


def score(videos: Tensor, scenes: Scenes) -> dict[str, Tensor]:
    """Score videos (B, C, F, H, W) of the scenes by name, float64 (B,), from their pixels and the known background.

    reward: task + 0.3 min(mass, 1) - 10 background; more opacity than the disc has pays nothing. task: mean
    exp(-path error / 2), in (0, 1]. mass: opacity kept, 1 is all of it. background: mean square error away from the
    disc. obeyed: 1 where the disc went more than MOVED_CELLS the commanded way. consistency: exp(-change from frame to
    frame / CHANGE), 1 for a picture that stands still.
    """
    scenes = scenes.to(videos.device)
    contrast = (COLOUR.to(videos.device).view(1, 2, 1, 1) - scenes.background)[:, :, None]
    seen = ((videos.float() - scenes.background[:, :, None]) * contrast).sum(1) / contrast.square().sum(1)
    alpha = seen.clamp(0, 1)
    alpha = torch.where(alpha > 0.15, alpha, 0.0)  # texture errors are no disc
    rows = torch.arange(scenes.side, dtype=torch.float32, device=videos.device)
    weight = alpha.sum((2, 3)).clamp_min(1e-6)
    centre = torch.stack([(alpha.sum(3) * rows).sum(2) / weight, (alpha.sum(2) * rows).sum(2) / weight], 2)
    wanted = scenes.path(scenes.action)
    lost = alpha.sum((2, 3)) < 0.5 * scenes.scale**2
    distance = (centre - wanted).norm(dim=2) / scenes.scale
    error = torch.where(lost, torch.full_like(distance, SIDE), distance)
    reach = NEAR * RADIUS * scenes.scale
    near = torch.maximum(*(opacity_at(place, reach, scenes.side) for place in (centre, wanted)))
    away = (near < 0.6)[:, None]
    wrong = (videos.float() - scenes.background[:, :, None]).square() * away
    travelled = ((centre[:, -1] - centre[:, 0]) * DIRECTIONS.to(videos.device)[scenes.action]).sum(1) / scenes.scale
    change = videos.float().diff(dim=2).square().mean((1, 2, 3, 4))
    task = torch.exp(-error[:, 1:] / 2).mean(1).double()
    mass = (alpha[:, 1:].sum((2, 3)).mean(1) / alpha[:, 0].sum((1, 2)).clamp_min(1e-6)).double()
    background = (wrong[:, :, 1:].sum((1, 2, 3, 4)) / (2 * away[:, :, 1:].sum((1, 2, 3, 4))).clamp_min(1)).double()
    return {
        "reward": task + 0.3 * mass.clamp(max=1) - 10 * background, "task": task, "mass": mass,
        "background": background, "obeyed": ((travelled > MOVED_CELLS) & ~lost[:, -1]).double(),
        "consistency": torch.exp(-change / CHANGE).double(),
    }


@dataclass(frozen=True)
class SceneRequest:
    """What to sample: a group of videos of each scene."""

    scenes: Scenes
    """Of the iteration."""
    iteration: int
    """Of the learner."""
    policy_version: int
    """Of the weights that sample."""


class ToyContexts:
    """Scenes as a source of post-training (train.ClipSource), drawn anew for every iteration.

    Args:
        network: samples as it is, so loading newer weights into it is enough.
        config: its seed, groups, window and rollout are used.
        side: of the pictures, px.
        reward: the score that trains, a name of score().
    """

    def __init__(
        self, network: VideoNetwork, config: VideoRlConfig, *, side: int = SIDE, reward: str = "reward"
    ) -> None:
        self.network, self.config, self.side, self.reward = network, config, side, reward

    def request(self, iteration: int, policy_version: int) -> SceneRequest:
        scenes = draw_scenes(self.config.groups.contexts, self.config.seed, "rollouts", iteration, self.side)
        return SceneRequest(scenes, iteration, policy_version)

    def sample(self, request: SceneRequest) -> RolloutBuffer:
        """Sample len(scenes) x group_size videos without rewards."""
        size, iteration = self.config.groups.group_size, request.iteration
        index = torch.arange(len(request.scenes)).repeat_interleave(size)
        samples = torch.arange(size).repeat(len(request.scenes))
        first = index * size if self.config.groups.shared_noise else index * size + samples
        noise = self._noise(request.scenes, self._seeds("initial", iteration, first))
        seeds = self._seeds("steps", iteration, index * size + samples)
        self.network.eval()
        return sample_buffer(
            self.network, self.config, request.scenes.rows(index).condition(), noise, seeds, index, samples, iteration,
            request.policy_version,
        )

    def score(self, request: SceneRequest, clips: RolloutBuffer) -> RolloutBuffer:
        """Return the buffer with every score of its videos, and as `total` the one that trains."""
        scores = score(clips.rollout.latents, request.scenes.rows(clips.group_ids))
        return clips.with_rewards({**scores, "total": scores[self.reward]})

    def evaluate(self, scenes: Scenes) -> dict[str, Tensor]:
        """Score one video of each scene, sampled by ODE."""
        seeds, settings = self._seeds("evaluation", 0, torch.arange(len(scenes))), self.config.rollout
        self.network.eval()
        noise = self._noise(scenes, seeds)
        device = device_of(self.network)
        rollout = sample_videos(self.network, scenes.condition().to(device), noise.to(device), seeds, settings, [])
        return score(rollout.latents, scenes)

    def _noise(self, scenes: Scenes, seeds: Tensor) -> Tensor:
        return initial_noise((CHANNELS, FRAMES, scenes.side, scenes.side), seeds)

    def _seeds(self, name: str, iteration: int, numbers: Tensor) -> Tensor:
        seeds = (stream_seed(self.config.seed, f"moving_disc_{name}", iteration, int(number)) for number in numbers)
        return torch.tensor([seed % MAX_SEED for seed in seeds])


def opacity_at(centres: Tensor, radius: float = RADIUS, side: int = SIDE) -> Tensor:
    """A Gaussian disc at each centre (B, F, 2): (B, F, side, side), 1 in its middle."""
    rows = torch.arange(side, dtype=torch.float32, device=centres.device)
    down = (rows - centres[..., :1]).square()[..., :, None]
    across = (rows - centres[..., 1:]).square()[..., None, :]
    return torch.exp(-(down + across) / (2 * radius**2))


def load_base(path: Path | None = None, device: torch.device | str = "cpu") -> VideoNetwork:
    """The base model on `device`: the one at `path`, or the shipped one."""
    model = VideoNetwork(NETWORK)
    load_weights_file(model, path or BASE)
    return model.to(device).eval()
