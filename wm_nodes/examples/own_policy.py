"""A policy that sees by an encoder of your own instead of the world model's tokenizer; see policy_rl/image_policy.py.

python -m wm_nodes.policy_rl.train --policy.factory examples.own_policy:make
    --preset smoke --updates 3 --ppo.num_steps 16
"""
import torch
from torch import Tensor, nn

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import initial_weights
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy

CHANNELS = 16


def make(config: RunConfig) -> ImagePolicy:
    """Random convolutions, which stay as they are, or yours: a ResNet, DINO, whatever gives features."""
    with initial_weights(config.seed, "own_encoder"):
        network = nn.Sequential(
            nn.Conv2d(3, CHANNELS, 8, stride=8), nn.ReLU(), nn.AdaptiveAvgPool2d(4), nn.Flatten()
        ).requires_grad_(False)

    def encode(images_BHWC: Tensor) -> Tensor:
        features: Tensor = network.to(images_BHWC.device)(images_BHWC.movedim(-1, 1).to(torch.float32) / 255)
        return features

    spec = configured_spec(config)
    return ImagePolicy(
        ImageEncoder(encode, CHANNELS * 4 * 4), spec.state_dim, spec.action_dim, config.policy, seed=config.seed
    )
